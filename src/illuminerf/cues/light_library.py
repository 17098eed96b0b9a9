"""Environment maps for training: files in a folder, and the same maps at one size where all workers reach them."""

import functools
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from illuminerf.scene.environment import EnvironmentMap
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.storage import Storage

_SUFFIXES = (".exr", ".hdr")
_KEPT_IN_MEMORY = 64


def light_paths(folder: Path) -> list[Path]:
    """The .exr and .hdr maps directly in a folder, by name.

    Raises:
        UserError: the folder does not exist, or two maps have one name.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder", wanted="a folder of .exr or .hdr environment maps")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.name[0] != ".")
    stems = [path.stem for path in paths]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice:
        raise UserError(f"{folder} holds the light '{twice}' twice", fix="remove one of the files")
    return paths


@dataclass(frozen=True)
class StoredLights(Sequence[EnvironmentMap]):
    """Maps at one size, float32, in a storage; read when they are needed."""

    url: str
    """Of the storage."""
    files: tuple[str, ...]
    """Names in it, one per map, `<folder>/<light>.npy`."""

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> EnvironmentMap:  # type: ignore[override]
        return _stored_light(self.url, self.files[index])


def light_names(files: Sequence[str]) -> list[str]:
    """Names of stored maps."""
    return [file.rpartition("/")[2].removesuffix(".npy") for file in files]


def store_light(storage: Storage, folder: str, path: Path, height: int) -> str:
    """Bring a map to `height` rows by areas, since all lights of one scene need one resolution, and write it; its name.

    Raises:
        UserError: the map is unreadable, not 2:1, not finite, negative or all black.
    """
    light = EnvironmentMap.load(path).resized(height)
    content = io.BytesIO()
    np.save(content, light.linear_rgb, allow_pickle=False)
    name = f"{folder}/{path.stem}.npy"
    storage.write(name, content.getvalue())
    return name


@functools.lru_cache(maxsize=_KEPT_IN_MEMORY)
def _stored_light(url: str, file: str) -> EnvironmentMap:
    image = np.load(io.BytesIO(Storage(url).read(file)), allow_pickle=False)
    return EnvironmentMap(image, *light_names([file]))
