"""A folder of environment maps, read when they are needed."""

import functools
from pathlib import Path

from illuminerf.scene.environment import EnvironmentMap
from illuminerf.workflow.errors import UserError

_KEPT_IN_MEMORY = 64


def light_paths(folder: Path) -> list[Path]:
    """The .exr and .hdr maps directly in a folder, by name.

    Raises:
        UserError: the folder does not exist, or two maps have one name.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder", wanted="a folder of .exr or .hdr environment maps")
    paths = sorted([*folder.glob("*.exr"), *folder.glob("*.hdr")])
    stems = [path.stem for path in paths]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice:
        raise UserError(f"{folder} holds the light '{twice}' twice", fix="remove one of the files")
    return paths


@functools.lru_cache(maxsize=_KEPT_IN_MEMORY)
def load_light(path: Path, height: int) -> EnvironmentMap:
    """A map brought to `height` rows by areas, so that all lights of one scene have one resolution.

    Raises:
        UserError: the map is unreadable, not 2:1, not finite, negative or all black.
    """
    return EnvironmentMap.load(path).resized(height)
