"""Objects of Objaverse fetched by the `objaverse` package, when a person asks for it and never otherwise."""

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say

_VERSION_FOLDER = "hf-objaverse-v1"


def download_objaverse(ids: Sequence[str], root: Path, num_processes: int = 1) -> dict[str, Path]:
    """Download objects (0.1 to 100 MB each) into `root/hf-objaverse-v1/glbs`; what is there is not fetched again.

    Args:
        ids: Objaverse ids.
        root: any folder; created.
        num_processes: parallel downloads.

    Returns:
        The file of every id.

    Raises:
        UserError: the package or the network is absent, or a file did not arrive.
    """
    if not ids:
        return {}
    root = root.expanduser().resolve()
    package = _package()
    root.mkdir(parents=True, exist_ok=True)
    say(f"downloading {len(ids):,} objects of Objaverse into {root}")
    try:
        with _downloads_into(package, root):
            found = package.load_objects(uids=list(ids), download_processes=num_processes)
    except OSError as error:  # urllib's errors are OSErrors
        raise UserError(
            "Objaverse could not be downloaded",
            got=f"{type(error).__name__}: {error}",
            fix="check the connection and start again; what has arrived is kept",
        ) from error
    paths = {uid: Path(found[uid]) for uid in ids if uid in found}
    absent = [uid for uid in ids if uid not in paths or not _is_glb(paths[uid])]
    if absent:
        raise UserError(
            "objects of Objaverse did not arrive",
            got=f"{len(absent):,} of {len(ids):,} are absent or no GLB files, {absent[0]} first",
            fix="check the ids, remove broken files, and start again",
        )
    return paths


def _package() -> Any:
    try:
        return importlib.import_module("objaverse")
    except ImportError as error:
        raise UserError(
            "downloading Objaverse needs the package objaverse",
            got=str(error),
            fix="pip install 'illuminerf[objaverse]'",
        ) from error


@contextmanager
def _downloads_into(package: Any, root: Path) -> Iterator[None]:
    """The package knows one folder, under the home directory; while this lasts it is `root`."""
    wanted = {"BASE_PATH": str(root), "_VERSIONED_PATH": str(root / _VERSION_FOLDER)}
    if not all(hasattr(package, name) for name in wanted):
        raise UserError(
            "this version of the package objaverse is not known",
            got=str(getattr(package, "__version__", "unknown")),
            wanted="0.1",
            fix="pip install 'objaverse<0.2'",
        )
    before = {name: getattr(package, name) for name in wanted}
    try:
        for name, value in wanted.items():
            setattr(package, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(package, name, value)


def _is_glb(path: Path) -> bool:
    try:
        with open(path, "rb") as file:
            return file.read(4) == b"glTF"
    except OSError:
        return False
