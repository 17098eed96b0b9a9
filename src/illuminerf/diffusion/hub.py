"""Pretrained weights that live elsewhere: what they are, where they belong on this machine, and fetching them.

Nothing here runs unasked: only `illuminerf models download` reaches out. A repository lands in
`<models home>/<owner>--<name>/` with its files as on the hub, so that it can also be put there by hand.
"""

import hashlib
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError, HFValidationError

from illuminerf.diffusion.dilightnet import DILIGHTNET
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say


@dataclass(frozen=True)
class HubFile:
    """One file of a repository."""

    path: str
    """Inside the repository."""
    sha256: str = ""
    """Of its content, "" where it is not known."""
    size_bytes: int = 0
    """0 where it is not known."""


@dataclass(frozen=True)
class HubRepository:
    """What is needed of one repository on the hub."""

    id: str
    """Owner and name."""
    revision: str
    """The commit, or a branch where no commit is known."""
    files: tuple[HubFile, ...]
    """Safetensors and JSON only."""
    licence: str
    """Its name."""


@dataclass(frozen=True)
class KnownModel:
    """A relighting model that has a name."""

    name: str
    """On the command line."""
    purpose: str
    """What it is for."""
    licence: str
    """Of our part or the published weights; a base has its own."""
    size: str
    """On disk, roughly."""
    repositories: tuple[HubRepository, ...] = ()
    """What a download fetches."""


_JSON = ("unet/config.json", "vae/config.json", "scheduler/scheduler_config.json", "text_encoder/config.json")
SD21 = HubRepository(
    id=DILIGHTNET.base,
    revision=DILIGHTNET.revision,
    licence="CreativeML Open RAIL++-M",
    files=(
        HubFile("unet/config.json", "dc987e214928b191cb832df4e19c376e862af1e4c4a5f36aac054a53ee251ccf", 939),
        HubFile("vae/config.json", "d69281aa3f6a0f3c41aaf6778e35464fc6ee8a92e6ac8a8b1eb679f6df6423eb", 611),
        HubFile("text_encoder/config.json", "6b34b0bf6cff02e2afe88145740ef5e0316caf7add8307c8ec0b021a7923cc42", 633),
        HubFile(
            "scheduler/scheduler_config.json", "4cd9b9597ca64549df35016ca02bd3450ecbac70ccd8b0465b018be4ba54fe4b", 345
        ),
        HubFile(
            "tokenizer/special_tokens_map.json",
            "f118ab3a983206e4f32583448de6bd6aae4ee21869135cef1f5848a753cdaab6",
            460,
        ),
        HubFile(
            "text_encoder/model.fp16.safetensors",
            "681c555376658c81dc273f2d737a2aeb23ddb6d1d8e5b3a7064636d359a22668",
            680821096,
        ),
        HubFile(
            "vae/diffusion_pytorch_model.fp16.safetensors",
            "3e4c08995484ee61270175e9e7a072b66a6e4eeb5f0c266667fe1f45b90daf9a",
            167335342,
        ),
        HubFile(
            "unet/diffusion_pytorch_model.fp16.safetensors",
            "8a3a4d7978884c5e4ef00b62641b1b544b257be2f6715d984188610ad6475ad2",
            1731904736,
        ),
    ),
)
DILIGHTNET_CONTROL = HubRepository(
    id="dilightnet/DiLightNet",
    revision="main",
    licence="MIT",
    files=(HubFile("config.json"), HubFile("diffusion_pytorch_model.safetensors")),
)
KNOWN = {
    model.name: model
    for model in (
        KnownModel("embedded", "ships with the package, runs on a CPU; 128x128 inside", "Apache-2.0", "12 MB"),
        KnownModel(
            "dilightnet",
            "published weights for a GPU; 512x512 inside, base SD 2.1",
            "MIT; base: CreativeML Open RAIL++-M",
            "4 GB",
            (DILIGHTNET_CONTROL, SD21),
        ),
        KnownModel(
            "paper",
            "the paper's architecture on any base of the Stable Diffusion class, to be trained (docs/training.md)",
            "Apache-2.0; base: CreativeML Open RAIL++-M",
            "2.6 GB (base)",
            (SD21,),
        ),
    )
}


def models_home() -> Path:
    """ILLUMINERF_MODELS, else ~/.cache/illuminerf/models."""
    named = os.environ.get("ILLUMINERF_MODELS", "")
    return Path(named) if named else Path.home() / ".cache" / "illuminerf" / "models"


def repository_folder(repository_id: str) -> Path:
    """Where a repository's files belong on this machine."""
    return models_home() / repository_id.replace("/", "--")


def base_repository(repository_id: str, revision: str = "") -> HubRepository:
    """The files that are needed of a base; for SD 2.1 the known ones, for others the hub's usual names."""
    if repository_id == SD21.id and revision in ("", SD21.revision):
        return SD21
    weights = ("unet/diffusion_pytorch_model", "vae/diffusion_pytorch_model", "text_encoder/model")
    names = (*_JSON, "tokenizer/special_tokens_map.json", *(f"{name}.safetensors" for name in weights))
    files = tuple(HubFile(name) for name in names)
    return HubRepository(repository_id, revision or "main", files, "see its page on the hub")


def find_base(base: str, revision: str = "") -> Path:
    """The folder of a base named by folder or hub id.

    Raises:
        UserError: it is not on this machine; says which files to put where.
    """
    if base and Path(base).is_dir():
        return Path(base)
    if base.count("/") != 1 or base.startswith(("/", ".", "~")):
        raise UserError(f"the base '{base}' does not exist", wanted="a folder, or an id of the hub such as " + SD21.id)
    folder = repository_folder(base)
    if (folder / "unet" / "config.json").is_file():
        return folder
    raise UserError(
        f"the base '{base}' is not on this machine",
        wanted=placement([base_repository(base, revision)]),
        fix=f"run 'illuminerf models download paper --base {base}', or put the files there by hand",
    )


def placement(repositories: list[HubRepository]) -> str:
    """Which files belong where, in words."""
    return "; ".join(
        f"{', '.join(file.path for file in repository.files)} of {repository.id} "
        f"(revision {repository.revision}) in {repository_folder(repository.id)}"
        for repository in repositories
    )


def download(name: str, base: str = "", revision: str = "") -> list[Path]:
    """Fetch what `name` needs, and return the folders; files that are there and whole are kept.

    Args:
        name: one of `KNOWN`.
        base: another base of the hub than SD 2.1, for "paper".
        revision: another commit or branch than the pinned one, of the model's first repository.

    Raises:
        UserError: no such model, the hub cannot be reached or lacks a file, or a file is not the expected one.
    """
    if name not in KNOWN:
        raise UserError("unknown model", got=repr(name), wanted=" or ".join(KNOWN))
    repositories = list(KNOWN[name].repositories)
    if base:
        if name != "paper":
            raise UserError(f"'{name}' has a base of its own", fix="leave out --base")
        repositories = [base_repository(base)]
    if revision and repositories:
        repositories[0] = replace(repositories[0], revision=revision, files=_unknown(repositories[0].files))
    for repository in repositories:
        for file in repository.files:
            _fetch(repository, file, repositories)
    return [repository_folder(repository.id) for repository in repositories]


def _unknown(files: tuple[HubFile, ...]) -> tuple[HubFile, ...]:
    """Of another revision no checksum is pinned."""
    return tuple(HubFile(file.path) for file in files)


def _fetch(repository: HubRepository, file: HubFile, wanted: list[HubRepository]) -> None:
    target = repository_folder(repository.id) / file.path
    # A revision that was asked for by name has no checksums: the hub's client decides whether a file is current.
    is_known = repository.revision in (known.revision for known in (SD21, DILIGHTNET_CONTROL))
    recorded = _recorded(repository).get(file.path, "")
    if is_known and target.is_file() and _sha256(target) == (file.sha256 or recorded or _sha256(target)):
        return
    say(f"{repository.id}: {file.path}" + (f" ({file.size_bytes / 1e6:.0f} MB)" if file.size_bytes > 1e6 else ""))
    try:
        hf_hub_download(
            repository.id, file.path, revision=repository.revision, local_dir=repository_folder(repository.id)
        )
    except (EntryNotFoundError, HfHubHTTPError, HFValidationError, OSError) as error:
        raise UserError(
            f"{file.path} of {repository.id} could not be downloaded",
            got=str(error).strip().splitlines()[0],
            wanted=placement(wanted),
            fix="try again where the hub can be reached, or put these files there by hand",
        ) from error
    found, expected = _sha256(target), file.sha256 or _sum_of_hub(repository, file)
    if expected and found != expected:
        target.unlink()
        raise UserError(
            f"{file.path} of {repository.id} is not the expected file, and was removed",
            wanted=f"sha256 {expected}",
            fix="download it again",
        )
    if not file.sha256:
        write_json(_record(repository), _recorded(repository) | {file.path: found})


def _record(repository: HubRepository) -> Path:
    return repository_folder(repository.id) / "downloaded.json"


def _recorded(repository: HubRepository) -> dict[str, str]:
    """The sha256 that files had when they were downloaded, by path, of those that have no pinned one."""
    record = _record(repository)
    return dict(read_json(record)) if record.is_file() else {}


def _sum_of_hub(repository: HubRepository, file: HubFile) -> str:
    """The sha256 that the hub itself names for a large file, as its client notes it beside the download; else ""."""
    note = repository_folder(repository.id) / ".cache" / "huggingface" / "download" / f"{file.path}.metadata"
    lines = note.read_text(errors="replace").splitlines() if note.is_file() else []
    return lines[1] if len(lines) > 1 and re.fullmatch("[0-9a-f]{64}", lines[1]) else ""


def _sha256(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
