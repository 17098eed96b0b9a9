from dataclasses import dataclass, field
from typing import Literal

import pytest

from illuminerf.workflow.config import changed, first_difference, from_json, to_json
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class Inner:
    rate: float = 0.5


@dataclass(frozen=True)
class Outer:
    steps: int
    inner: Inner = field(default_factory=Inner)
    sizes: tuple[int, ...] = (1, 2)
    kind: Literal["a", "b"] = "a"
    limit: int | None = None


@dataclass(frozen=True)
class Several:
    kind: Literal["a", "b"] | Literal["auto"] | int = "auto"


def test_round_trip() -> None:
    config = Outer(3, Inner(0.25), (4, 5, 6), "b", 7)
    assert from_json(Outer, to_json(config)) == config


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"steps": 1, "stepps": 2}, "no field 'stepps'"),
        ({}, "lacks the field 'steps'"),
        ({"steps": "many"}, "wrong type"),
        ({"steps": True}, "wrong type"),
        ({"steps": 1, "kind": "c"}, "not a known choice"),
        ({"steps": 1, "inner": {"rat": 1}}, "no field 'rat'"),
    ],
)
def test_mistakes_are_named(content: dict, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(UserError, match=message):
        from_json(Outer, content)


def test_first_difference_names_nested_fields() -> None:
    assert first_difference({"a": {"b": 1}}, {"a": {"b": 1}}) is None
    assert first_difference({"a": {"b": 1}}, {"a": {"b": 2}}) == "a.b is 1 there and 2 here"
    assert "absent" in (first_difference({"a": 1}, {"a": 1, "c": 2}) or "")


def test_one_field_is_changed_by_its_dotted_name() -> None:
    assert changed(Outer(3), "inner.rate", 1) == Outer(3, Inner(1.0))
    assert changed(Outer(3), "sizes", [7]) == Outer(3, sizes=(7,))
    for name, value, message in (
        ("inner.rat", 1, "Inner has no field 'rat'"),
        ("steps", "many", "Outer.steps has the wrong type"),
        ("steps.more", 1, "Outer.steps has no fields"),
        ("kind", "c", "not a known choice"),
    ):
        with pytest.raises(UserError, match=message):
            changed(Outer(3), name, value)


def test_a_field_of_several_types_takes_any_of_them() -> None:
    for value in ("auto", "a", 3):
        assert from_json(Several, {"kind": value}) == Several(value)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="wrong type"):
        from_json(Several, {"kind": "z"})
