"""Folders that earlier releases made: what their keys lack is filled in, so that they still load.

Every artefact's config.json says by which schema it was written. Whoever adds a field to a stage's config raises
`SCHEMA` by one and adds a line to `_NEW_FIELDS`, with the value that does what the stage did before. An old folder then
has the key that today's program would write for the same settings. tests/test_first_release.py fails where the line is
missing.
"""

import copy
from dataclasses import dataclass
from typing import Any

from illuminerf.workflow.errors import UserError

SCHEMA = 6


@dataclass(frozen=True)
class NewField:
    """A field of a stage's config that earlier schemas did not have."""

    schema: int
    """The first schema that has it."""
    stage: str
    """The stage as its config.json names it."""
    name: str
    """Below the config, with dots: "optimiser.precision"."""
    value: Any
    """What reproduces the stage without it, as JSON."""


_NEW_FIELDS = (
    NewField(2, "render_radiance_cues", "shard", ""),
    NewField(3, "estimate_geometry", "losses.random_background", False),
    NewField(4, "estimate_geometry", "losses.guided_share", 0.0),
    NewField(4, "estimate_geometry", "outlines_set_level", False),
    NewField(5, "estimate_geometry", "mesh_normals", "predicted"),
    NewField(6, "fit_latent_nerf", "zero_code_share", 0.0),
)


def upgraded(key: Any, where: str, fields: tuple[NewField, ...] = _NEW_FIELDS, schema: int = SCHEMA) -> Any:
    """The key in a config.json as today's schema would have it; `key` itself is not changed.

    Args:
        key: {"schema": ..., "stage": ..., "config": {...}}.
        where: the folder, for messages.
        fields: what was added since the first schema.
        schema: today's.

    Raises:
        UserError: it is no key, or a later release wrote it.
    """
    found = key.get("schema") if isinstance(key, dict) else None
    if type(found) is not int or found < 1 or not isinstance(key.get("config"), dict):
        raise UserError(
            f"{where}/config.json does not say what made the folder",
            got=f"schema {found!r}",
            wanted=f"a schema from 1 to {schema}",
            fix="restore the file, or delete the folder and run again",
        )
    if found > schema:
        raise UserError(
            f"{where} was made by a later release",
            got=f"schema {found}",
            wanted=f"at most {schema}",
            fix="update illuminerf, or choose another --out",
        )
    key = copy.deepcopy(key)
    for field in fields:
        if found < field.schema <= schema and field.stage == key.get("stage"):
            _fill(key["config"], field)
    return key | {"schema": schema}


def _fill(config: dict[str, Any], field: NewField) -> None:
    *parents, last = field.name.split(".")
    for parent in parents:
        below = config.get(parent)
        if not isinstance(below, dict):  # an optional part that this folder was made without
            return
        config = below
    config.setdefault(last, field.value)
