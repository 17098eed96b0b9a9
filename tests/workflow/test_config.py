from dataclasses import dataclass, field
from typing import Literal

import pytest

from illuminerf.workflow.config import first_difference, from_json, to_json
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
