"""Frozen dataclasses to JSON and back, strictly: unknown, missing and mistyped fields are errors."""

import contextlib
import dataclasses
import functools
import types
import typing
from pathlib import Path
from typing import Any, TypeVar, Union

from illuminerf.workflow.errors import UserError

ConfigType = TypeVar("ConfigType")
_LARGEST_FLOAT = 10**308


def to_json(config: Any) -> Any:
    """Turn a (nested) frozen dataclass into plain JSON types."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {field.name: to_json(getattr(config, field.name)) for field in dataclasses.fields(config)}
    if isinstance(config, (tuple, list)):
        return [to_json(item) for item in config]
    if isinstance(config, dict):
        return {str(key): to_json(value) for key, value in config.items()}
    if isinstance(config, Path):
        return str(config)
    return config


def from_json(cls: type[ConfigType], content: Any) -> ConfigType:
    """Build the dataclass `cls` from what `to_json` made of it.

    Raises:
        UserError: a field is unknown, missing, or of the wrong type.
    """
    if not isinstance(content, dict):
        raise UserError(f"{cls.__name__} must be a JSON object", got=type(content).__name__)
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    unknown = sorted(set(content) - set(fields))
    if unknown:
        raise UserError(f"{cls.__name__} has no field '{unknown[0]}'", wanted=", ".join(fields))
    hints = _type_hints(cls)  # type: ignore[arg-type]
    for name, field in fields.items():
        has_default = not (field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING)
        if name not in content and not has_default:
            raise UserError(f"{cls.__name__} lacks the field '{name}'")
    values = {name: coerced(f"{cls.__name__}.{name}", hints[name], value) for name, value in content.items()}
    try:
        return cls(**values)
    except (ValueError, TypeError, ArithmeticError) as error:
        raise UserError(f"{cls.__name__} cannot be as it is written", got=str(error)) from error


@functools.cache
def _type_hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def coerced(name: str, hint: Any, value: Any) -> Any:
    """A JSON value as the type `hint`; `name` is what messages call it.

    Raises:
        UserError: it has another type.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _coerced_to_one(name, [argument for argument in arguments if argument is not type(None)], value)
    if dataclasses.is_dataclass(hint):
        return from_json(hint, value)  # type: ignore[arg-type]
    if origin is tuple:
        if not isinstance(value, list):
            raise UserError(f"{name} must be a list", got=type(value).__name__)
        variadic = len(arguments) == 2 and arguments[1] is Ellipsis
        items = [arguments[0]] * len(value) if variadic else list(arguments)
        if len(items) != len(value):
            raise UserError(f"{name} has {len(value)} entries", wanted=str(len(items)))
        return tuple(coerced(name, item, entry) for item, entry in zip(items, value, strict=True))
    if origin is dict:
        if not isinstance(value, dict):
            raise UserError(f"{name} must be an object", got=type(value).__name__)
        return {key: coerced(f"{name}.{key}", arguments[1], entry) for key, entry in value.items()}
    if origin is typing.Literal:
        if value not in arguments:
            raise UserError(f"{name} is not a known choice", got=repr(value), wanted=", ".join(map(str, arguments)))
        return value
    if hint is Path:
        return Path(value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool) and abs(value) < _LARGEST_FLOAT:
        return float(value)
    if hint in (int, float, str, bool) and type(value) is not hint:
        raise UserError(f"{name} has the wrong type", got=type(value).__name__, wanted=hint.__name__)
    return value


def _coerced_to_one(name: str, hints: list[Any], value: Any) -> Any:
    """The value as the first of several types that takes it; the last one's complaint where none does."""
    for hint in hints[:-1]:
        with contextlib.suppress(UserError):
            return coerced(name, hint, value)
    return coerced(name, hints[-1], value)


def changed(config: ConfigType, name: str, value: Any) -> ConfigType:
    """A copy of a (nested) frozen dataclass with one field changed, by its dotted name, to a JSON value.

    Raises:
        UserError: there is no such field, or the value has the wrong type or is out of range.
    """
    first, _, rest = name.partition(".")
    if first not in (fields := [field.name for field in dataclasses.fields(config)]):  # type: ignore[arg-type]
        raise UserError(f"{type(config).__name__} has no field '{first}'", wanted=", ".join(fields))
    if not rest:
        hint = _type_hints(type(config))[first]  # type: ignore[arg-type]
        new = coerced(f"{type(config).__name__}.{first}", hint, value)
    elif dataclasses.is_dataclass(part := getattr(config, first)):
        new = changed(part, rest, value)
    else:
        raise UserError(f"{type(config).__name__}.{first} has no fields", got=name, fix=f"set {first} itself")
    return dataclasses.replace(config, **{first: new})  # type: ignore[type-var]


def first_difference(old: Any, new: Any, name: str = "") -> str | None:
    """Name the first field in which two JSON values differ, with both values, or None where they agree."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(set(old) | set(new)):
            path = f"{name}.{key}" if name else key
            if key not in old or key not in new:
                return f"{path} is {old.get(key, 'absent')!r} there and {new.get(key, 'absent')!r} here"
            difference = first_difference(old[key], new[key], path)
            if difference:
                return difference
        return None
    return None if old == new else f"{name} is {old!r} there and {new!r} here"
