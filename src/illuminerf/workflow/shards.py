"""WebDataset shards: tar files of samples, each with an index that says what it must hold.

`<name>.tar` holds the samples in order, `<name>.json` its sha256, size, keys and what was left out and why. The index
is written last, so a shard with an index is finished and never written again. Equal samples give equal bytes: no
times, owners or other traces of the machine enter the tar.
"""

import hashlib
import io
import json
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from illuminerf.workflow.config import from_json, to_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.storage import Storage

INDEX_SCHEMA = 1


@dataclass(frozen=True)
class LeftOut:
    """A sample that could not be made."""

    reason: str
    """One word or two, for counting."""
    message: str
    """What exactly was wrong."""


@dataclass(frozen=True)
class ShardIndex:
    """What one shard holds."""

    name: str
    """Without suffix."""
    keys: tuple[str, ...]
    """Of the samples, in order."""
    sha256: str
    """Of the tar."""
    num_bytes: int
    """Of the tar."""
    left_out: dict[str, LeftOut] = field(default_factory=dict)
    """By key, the planned samples that are missing."""
    schema: int = INDEX_SCHEMA
    """Version of this layout."""
    seal: str = ""
    """sha256 of the rest of this index; empty where it was written before there were seals."""

    def sealed(self) -> "ShardIndex":
        """The same with its seal."""
        rest = json.dumps(to_json(replace(self, seal="")), sort_keys=True)
        return replace(self, seal=hashlib.sha256(rest.encode()).hexdigest())


def sample_tar(key: str, files: dict[str, bytes]) -> bytes:
    """One sample as a whole little tar.

    Args:
        key: the sample's name; a dot would end it for WebDataset's readers.
        files: contents by extension, for example {"json": ..., "safetensors": ...}.
    """
    return _tar([(key, files)])


def _tar(samples: list[tuple[str, dict[str, bytes]]]) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for key, files in samples:
            if "." in key or "/" in key or not key:
                raise ValueError(f"{key!r} is no sample key: no dots, no slashes")
            for extension, content in sorted(files.items()):
                member = tarfile.TarInfo(f"{key}.{extension}")
                member.size, member.mode = len(content), 0o644
                tar.addfile(member, io.BytesIO(content))
    return stream.getvalue()


def read_samples(content: bytes) -> Iterator[tuple[str, dict[str, bytes]]]:
    """(key, contents by extension) of every sample in a tar, in order.

    Raises:
        UserError: the tar is damaged.
    """
    key = ""
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as tar:
            for member in tar:
                stem, _, extension = member.name.partition(".")
                if stem != key and files:
                    yield key, files
                    files = {}
                stream = tar.extractfile(member)
                if stream is None:
                    raise UserError("a shard holds something that is not a file", got=member.name)
                key, files[extension] = stem, stream.read()
    except tarfile.TarError as error:
        raise UserError("a shard is damaged", got=str(error), fix="run the stage that makes it again") from error
    if files:
        yield key, files


def write_shard(storage: Storage, name: str, samples: list[bytes], left_out: dict[str, LeftOut]) -> ShardIndex:
    """Join little tars (see `sample_tar`) into one shard and write it, then its index."""
    files = [pair for sample in samples for pair in read_samples(sample)]
    content = _tar(files)
    keys = tuple(key for key, _ in files)
    sha256 = hashlib.sha256(content).hexdigest()
    index = ShardIndex(name, keys, sha256, len(content), dict(sorted(left_out.items()))).sealed()
    storage.write(f"{name}.tar", content)
    storage.write_json(f"{name}.json", to_json(index))
    return index


def read_index(storage: Storage, name: str) -> ShardIndex | None:
    """The index of a shard; None where it is absent, damaged or of another layout, so that the shard counts as
    unfinished."""
    try:
        index = from_json(ShardIndex, json.loads(storage.read(f"{name}.json")))
    except (FileNotFoundError, ValueError, UserError):
        return None
    is_whole = index.seal in ("", index.sealed().seal)
    return index if is_whole and index.schema == INDEX_SCHEMA and index.name == name else None


def is_intact(storage: Storage, index: ShardIndex) -> bool:
    """Whether the shard's bytes are those that were written."""
    digest = hashlib.sha256()
    try:
        for chunk in storage.chunks(f"{index.name}.tar"):
            digest.update(chunk)
    except FileNotFoundError:
        return False
    return digest.hexdigest() == index.sha256


def remove_shard(storage: Storage, name: str) -> None:
    """Take a shard away; the index first, so that what is left never looks finished."""
    storage.remove(f"{name}.json")
    storage.remove(f"{name}.tar")


def finished_shards(storage: Storage) -> list[ShardIndex]:
    """Indices of all finished shards directly in the storage, by name."""
    stems = {name.removesuffix(".tar") for name in storage.names() if name.endswith(".tar")}
    indices = (read_index(storage, stem) for stem in sorted(stems))
    return [index for index in indices if index is not None]


def read_shard(storage: Storage, index: ShardIndex) -> Iterator[tuple[str, dict[str, bytes]]]:
    """The samples of a finished shard, after checking its bytes.

    Raises:
        UserError: the shard is missing or damaged.
    """
    where, fix = f"{storage.url}/{index.name}.tar", "render the pairs again with the same command: it mends the shard"
    try:
        content = storage.read(f"{index.name}.tar")
    except FileNotFoundError as error:
        raise UserError(f"{where} is missing", fix=fix) from error
    if hashlib.sha256(content).hexdigest() != index.sha256:
        raise UserError(f"{where} is damaged", got="another sha256 than its index says", fix=fix)
    yield from read_samples(content)
