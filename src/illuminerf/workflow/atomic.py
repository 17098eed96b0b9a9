"""Files that are either whole or absent: written beside their final name, synced, then renamed.

Below a folder under `recorded_writes` each file's sha256 is noted before it gets its name, so that a later run can tell
whether what a killed one left behind is still what it wrote.
"""

import errno
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any

from illuminerf.workflow.errors import UserError

JOURNAL = ".written"
"""File of a folder under `recorded_writes`: a line "<sha256>  <name>" for every file ever written there."""
PARTIAL = ".*.partial*"
"""Pattern of temporary names."""
_DISK_ERRORS = {
    errno.EIO,
    errno.EFBIG,
    errno.EMFILE,
    errno.ENFILE,
    errno.ESTALE,
    errno.ENODEV,
    errno.ENXIO,
    errno.ETIMEDOUT,
}
_recorded: list[Path] = []


@contextmanager
def recorded_writes(folder: Path) -> Iterator[None]:
    """Note the checksum of every file that this process writes below `folder` in the folder's JOURNAL."""
    resolved = folder.resolve()
    _recorded.append(resolved)
    try:
        yield
    finally:
        _recorded.remove(resolved)


def _record(path: Path, written: BufferedReader) -> None:
    resolved = path.resolve()
    for folder in {folder for folder in _recorded if resolved.is_relative_to(folder)}:
        name = resolved.relative_to(folder).as_posix()
        line = f"{hashlib.file_digest(written, 'sha256').hexdigest()}  {name}\n"
        with open(folder / JOURNAL, "ab", buffering=0) as journal:
            journal.write(line.encode())
        written.seek(0)


@contextmanager
def atomic_path(path: Path, grows: bool = False) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; on success it is renamed to `path`, else removed.

    The temporary name keeps the suffix, because writers choose their format by it.

    Args:
        path: the file.
        grows: lines will be appended to it, so that its checksum says nothing.

    Raises:
        UserError: the disk is full or the folder may not be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=f".partial{path.suffix}", dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise explained(error, path) from error
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb") as written:
            os.fsync(written.fileno())
            if not grows:
                _record(path, written)
        temporary.chmod(0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise explained(error, path) from error
    finally:
        with suppress(OSError):  # what stays behind, the next run removes
            temporary.unlink(missing_ok=True)


def remove_partial_files(folder: Path, deep: bool = True) -> None:
    """Delete what a killed process left behind inside `folder` (and below); whole files are never touched."""
    for leftover in (folder.rglob if deep else folder.glob)(PARTIAL):
        leftover.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes, grows: bool = False) -> None:
    """Write `content` to `path` atomically; `grows` as in `atomic_path`."""
    with atomic_path(path, grows) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically, with sorted keys so that equal contents are equal bytes."""
    write_bytes(path, (json.dumps(content, indent=2, sort_keys=True, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        UserError: the file is missing, unreadable or not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UserError(f"{path} is missing", wanted="a JSON file", fix="check the path") from error
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is not valid JSON",
            got=str(error),
            fix="restore the file or delete its folder and run again",
        ) from error
    except OSError as error:
        raise UserError(f"{path} cannot be read", got=str(error), fix="check the permissions") from error


@contextmanager
def explained_errors(folder: Path) -> Iterator[None]:
    """Turn errors of the disk under the block into UserErrors; `folder` is named where an error names no file."""
    try:
        yield
    except OSError as error:
        named = error.filename if isinstance(error.filename, (str, os.PathLike)) else folder
        raise explained(error, Path(named)) from error


def explained(error: OSError, path: Path) -> Exception:
    """A UserError where `error` is the disk's or the path's fault, else the error itself."""
    reason = error.strerror or str(error)
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UserError(
            f"the disk is full while writing {path}",
            fix="free some space and run the same command again; finished work is kept",
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        place = _nearest(path)
        if not os.access(place, os.R_OK | os.X_OK if place.is_dir() else os.R_OK):
            return UserError(f"{path} cannot be read", got=reason, fix=f"see to the permissions of {place}")
        return UserError(f"{path} cannot be written", got=reason, fix="choose another --out")
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return UserError(f"{path.parent} is not a folder", fix="choose another --out")
    if error.errno == errno.ENOENT and error.filename is not None:
        return UserError(f"{path} is missing", fix="check the path, or run the stage that makes it again")
    if error.errno in _DISK_ERRORS:
        return UserError(
            f"{path} cannot be read or written",
            got=reason,
            fix="see that the disk or network share answers, and run the same command again; finished work is kept",
        )
    return error


def check_writable(folder: Path) -> None:
    """Find out before long work that a folder can be made, and written to; nothing is made.

    Raises:
        UserError: it cannot.
    """
    place = _nearest(folder)
    if not place.is_dir():
        raise UserError(f"{folder} cannot be written", got=f"{place}, which is a file", fix="choose another --out")
    if not os.access(place, os.W_OK | os.X_OK):
        raise UserError(
            f"{folder} cannot be written", got=f"no permission to write to {place}", fix="choose another --out"
        )


def _nearest(path: Path) -> Path:
    """`path`, or the first folder above it that exists."""
    return next(place for place in (path, *path.absolute().parents) if os.path.lexists(place))
