"""Files that are either whole or absent: written beside their final name, synced, then renamed."""

import errno
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from illuminerf.workflow.errors import UserError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; on success it is renamed to `path`, else removed.

    The temporary name keeps the suffix, because writers choose their format by it.

    Raises:
        UserError: the disk is full or the folder may not be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=f".partial{path.suffix}", dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise _explained(error, path) from error
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb") as written:
            os.fsync(written.fileno())
        temporary.chmod(0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise _explained(error, path) from error
    finally:
        temporary.unlink(missing_ok=True)


def remove_partial_files(folder: Path, deep: bool = True) -> None:
    """Delete what a killed process left behind inside `folder` (and below); whole files are never touched."""
    for leftover in (folder.rglob if deep else folder.glob)(".*.partial*"):
        leftover.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically."""
    with atomic_path(path) as temporary:
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


def _explained(error: OSError, path: Path) -> Exception:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UserError(
            f"the disk is full while writing {path}",
            fix="free some space and run the same command again; finished work is kept",
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return UserError(f"{path} cannot be written", got=error.strerror or str(error), fix="choose another --out")
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return UserError(f"{path.parent} is not a folder", fix="choose another --out")
    return error
