"""A folder anywhere: on this machine or behind any fsspec URL (s3://, gs://, memory://). Writes are whole or absent."""

import errno
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
from fsspec.implementations.local import LocalFileSystem

from illuminerf.workflow.atomic import atomic_path, remove_partial_files, write_bytes
from illuminerf.workflow.errors import UserError

_CHUNK = 2**22


class Storage:
    """Named files below one root.

    Args:
        url: a path or an fsspec URL; credentials come from where that file system looks for them.

    Raises:
        UserError: the protocol is unknown or its package is not installed.
    """

    def __init__(self, url: str | Path) -> None:
        self.url = str(url)
        try:
            self._fs, self._root = fsspec.core.url_to_fs(self.url)
        except (ValueError, ImportError) as error:
            raise UserError(
                f"{self.url} is no place this program can write to",
                got=str(error),
                wanted="a folder or an fsspec URL",
                fix="install the package of that file system, for example pip install s3fs",
            ) from error
        self._root = self._root.rstrip("/") or "/"
        if isinstance(self._fs, LocalFileSystem):
            self.url = self._root  # absolute: workers elsewhere have another current folder

    @property
    def path(self) -> Path | None:
        """The root where it lies on this machine's file systems, else None."""
        return Path(self._root) if isinstance(self._fs, LocalFileSystem) else None

    def _path(self, name: str) -> str:
        if name.startswith("/") or ".." in name.split("/"):
            raise UserError(f"'{name}' would leave {self.url}", wanted="a name below it")
        return f"{self._root}/{name}" if name else self._root

    def write(self, name: str, content: bytes) -> None:
        """Write a file: on local file systems by rename, elsewhere by one upload, which object stores make atomic.

        Raises:
            UserError: the disk is full, or the place may not be written.
        """
        path = self._path(name)
        if self.path:
            write_bytes(Path(path), content)
            return
        try:
            try:
                self._fs.pipe_file(path, content)
            except FileNotFoundError:  # file systems with real folders
                self._fs.makedirs(path.rpartition("/")[0], exist_ok=True)
                self._fs.pipe_file(path, content)
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            raise UserError(
                f"{self.url}/{name} cannot be written",
                got=str(error),
                fix="free some space and run again" if full else "check the address and the credentials",
            ) from error

    def write_json(self, name: str, content: Any) -> None:
        """Write JSON with sorted keys, so that equal contents are equal bytes."""
        self.write(name, (json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n").encode())

    def read(self, name: str) -> bytes:
        """A file's content.

        Raises:
            FileNotFoundError: there is none.
        """
        return bytes(self._fs.cat_file(self._path(name)))

    def read_json(self, name: str) -> Any:
        """A JSON file's content; None where there is no such file.

        Raises:
            UserError: it is not JSON.
        """
        try:
            return json.loads(self.read(name))
        except FileNotFoundError:
            return None
        except ValueError as error:
            fix = "restore the file, or delete its folder and run again"
            raise UserError(f"{self.url}/{name} is not valid JSON", got=str(error), fix=fix) from error

    def chunks(self, name: str) -> Iterator[bytes]:
        """A file's content in pieces of a few MB.

        Raises:
            FileNotFoundError: there is none.
        """
        with self._fs.open(self._path(name), "rb") as stream:
            while piece := stream.read(_CHUNK):
                yield piece

    def exists(self, name: str = "") -> bool:
        """Whether there is a file of that name now."""
        self._fs.invalidate_cache()
        return bool(self._fs.exists(self._path(name)))

    def names(self, folder: str = "") -> list[str]:
        """Names of the visible files directly in `folder`, sorted, without it; none where it does not exist."""
        return [name for name, kind in self.entries(folder) if kind == "file" and not name.startswith(".")]

    def entries(self, folder: str = "") -> list[tuple[str, str]]:
        """(name, "file" or "directory") of everything directly in `folder`, sorted; none where it does not exist."""
        self._fs.invalidate_cache()
        path = self._path(folder)
        try:
            found = self._fs.ls(path, detail=True)
        except FileNotFoundError:
            return []
        named = ((entry["name"].rstrip("/").rpartition("/")[2], entry) for entry in found)
        return sorted(
            (name, entry["type"]) for name, entry in named if name and entry["name"].strip("/") != path.strip("/")
        )

    def tree(self, folder: str = "") -> list[str]:
        """Names of all files below `folder`, at any depth, sorted, without it; none where it does not exist."""
        self._fs.invalidate_cache()
        path = self._path(folder).strip("/")
        found = (name.strip("/") for name in self._fs.find(self._path(folder)))
        return sorted(name.removeprefix(f"{path}/") for name in found if name != path)

    def upload(self, source: Path, name: str) -> None:
        """Write a file from one on this machine, whole or not at all, without holding it in memory."""
        if self.path:
            with atomic_path(Path(self._path(name))) as temporary:
                shutil.copyfile(source, temporary)
            return
        self._fs.makedirs(self._path(name).rpartition("/")[0], exist_ok=True)
        self._fs.put_file(str(source), self._path(name))

    def download(self, name: str, target: Path) -> None:
        """Write a file's content to one on this machine, whole or not at all.

        Raises:
            FileNotFoundError: there is none.
        """
        with atomic_path(target) as temporary:
            self._fs.get_file(self._path(name), str(temporary))

    def check_reachable(self) -> None:
        """Ask the file system once, so that wrong addresses and credentials are found before any work is done.

        Raises:
            UserError: it does not answer.
        """
        try:
            self._fs.exists(self._root)
        except Exception as error:  # every file system has errors of its own
            raise UserError(
                f"{self.url} cannot be reached",
                got=f"{type(error).__name__}: {error}".splitlines()[0],
                fix="check the address, the network and the credentials",
            ) from error

    def remove(self, name: str) -> None:
        """Delete a file; no error where there is none."""
        try:
            self._fs.rm_file(self._path(name))
        except FileNotFoundError:
            return

    def remove_empty(self, folder: str) -> None:
        """Delete a folder that holds nothing; no error where there is none (object stores have no folders)."""
        if self.path and (path := Path(self._path(folder))).is_dir() and not any(path.iterdir()):
            path.rmdir()

    def remove_leftovers(self, folder: str = "") -> None:
        """Delete what a killed process had half written directly in a folder; whole files are never touched."""
        if self.path and (path := Path(self._path(folder))).is_dir():
            remove_partial_files(path, deep=False)
