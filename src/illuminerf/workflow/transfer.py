"""Artefact folders to and from a storage elsewhere. DONE goes last, so that what lies there is finished or not one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from illuminerf.workflow.storage import Storage


class TransferError(Exception):
    """A file could not be moved: the network, the disk or the place itself. It may work later."""


def fetch_folder(
    storage: Storage, folder: str, target: Path, is_wanted: Callable[[str], bool] = lambda _: True
) -> set[str]:
    """Bring the files of a folder to this machine, DONE last; files that are there are kept.

    Args:
        storage: where it lies.
        folder: below the storage; "" for all of it.
        target: on this machine.
        is_wanted: from a file's name, without the folder's, to whether it is brought.

    Returns:
        Names of all files that lie there and are wanted.

    Raises:
        TransferError: it cannot be read.
    """
    with _explained(f"{storage.url}/{folder} cannot be fetched"):
        names = [name for name in storage.tree(folder) if is_wanted(name)]
        for name in _done_last(names):
            if not (target / name).exists():
                storage.download(f"{folder}/{name}" if folder else name, target / name)
    return set(names)


def fetch_file(url: str, target: Path) -> None:
    """Bring one file, by its URL, to this machine.

    Raises:
        TransferError: it cannot be read.
    """
    parent, _, name = url.rpartition("/")
    with _explained(f"{url} cannot be fetched"):
        Storage(parent).download(name, target)


def store_files(source: Path, names: list[str], storage: Storage, folder: str = "") -> None:
    """Put files of a folder on this machine below `folder` of a storage, in order.

    Raises:
        TransferError: it cannot be written.
    """
    with _explained(f"{storage.url}/{folder} cannot be written"):
        for name in names:
            storage.upload(source / name, f"{folder}/{name}" if folder else name)


def store_folder(source: Path, storage: Storage, folder: str, there: set[str] | None = None) -> None:
    """Put a folder on this machine below `folder` of a storage, DONE last.

    Args:
        source: on this machine; hidden files, which are this machine's own, stay.
        storage: where it goes.
        folder: below the storage.
        there: names that need not be sent again.

    Raises:
        TransferError: it cannot be written.
    """
    files = (path for path in source.rglob("*") if path.is_file() and not path.name.startswith("."))
    names = {path.relative_to(source).as_posix() for path in files} - (there or set())
    store_files(source, _done_last(sorted(names)), storage, folder)


def _done_last(names: list[str]) -> list[str]:
    return sorted(names, key=lambda name: name == "DONE")


@contextmanager
def _explained(what: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # every file system has errors of its own
        said = (str(error).splitlines() or [""])[0]
        raise TransferError(f"{what} ({type(error).__name__}: {said})") from error
