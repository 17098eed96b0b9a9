"""`illuminerf models`: which relighting models there are, what they consist of, and fetching published weights."""

from pathlib import Path

import tyro
from rich.markup import escape
from rich.table import Table

from illuminerf.diffusion.hub import KNOWN, KnownModel, download, models_home, repository_folder
from illuminerf.diffusion.model_tables import layer_tables, model_on_meta, parameter_counts
from illuminerf.diffusion.pretrained import EMBEDDED, model_folder, pretrained_model
from illuminerf.diffusion.relighting_model import RelightingModel, save_model
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, show_table


def list_command() -> None:
    """List the relighting models: what each is for, its size, and where it is on this machine."""
    table = Table(title=f"Relighting models (downloads go to {models_home()})")
    for column in ("name", "what for", "size", "local", "path"):
        table.add_column(column, overflow="fold")
    for model in KNOWN.values():
        folders, missing = _places(model)
        where = "yes" if not missing else f"{len(missing)} files missing"
        table.add_row(model.name, model.purpose, model.size, where, escape(", ".join(map(str, folders))))
    show_table(table)


def info_command(name: tyro.conf.Positional[str]) -> None:
    """Parameters by module, the layers of the condition networks, and the licence, without reading any weights.

    Args:
        name: embedded, dilightnet or paper.
    """
    model = model_on_meta(name)
    say(f"[bold]{name}[/bold]: {escape(KNOWN[name].purpose)}; licence: {escape(KNOWN[name].licence)}", markup=True)
    counts = Table(title="Parameters")
    counts.add_column("module")
    counts.add_column("parameters", justify="right")
    for part, count in parameter_counts(model).items():
        counts.add_row(part, f"{count:,}")
    show_table(counts)
    for network, rows in layer_tables(model).items():
        table = Table(title=f"{network} at {model.image_size}x{model.image_size}")
        table.add_column("layer (kernel, stride, padding)")
        table.add_column("output")
        for layer in rows:
            table.add_row(layer.kind, " x ".join(map(str, layer.shape)))
        show_table(table)


def download_command(name: tyro.conf.Positional[str], base: str = "", revision: str = "") -> None:
    """Fetch published weights from the Hugging Face hub: safetensors and JSON only, checked where sums are known.

    Args:
        name: dilightnet, or paper for a base to train on.
        base: Another base than SD 2.1, by its id on the hub; for paper.
        revision: Another commit or branch than the pinned one.
    """
    if name == EMBEDDED:
        say("embedded ships with the package; nothing to download")
        return
    for folder in download(name, base, revision):
        say(f"done: {folder}")


def export_command(model: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path]) -> None:
    """Write a trained model of the embedded kind as it is shipped: float16 weights, no training state.

    Args:
        model: What train-rdm made.
        out: A new folder.
    """
    network = pretrained_model(model)
    if not isinstance(network, RelightingModel):
        raise UserError("only models of the embedded kind are exported so", got=f"a control on a base in {model}")
    if out.exists() and any(out.iterdir()):
        raise UserError(f"{out} is not empty", fix="choose a new folder")
    save_model(network, out, half=True)
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    say(f"done: {out}, {size / 1e6:.1f} MB")


def _places(model: KnownModel) -> tuple[list[Path], list[Path]]:
    """(the model's folders, files that are missing from them)."""
    if model.name == EMBEDDED:
        try:
            return [model_folder(EMBEDDED)], []
        except UserError:
            return [], [Path("relighting_model.json")]
    folders = [repository_folder(repository.id) for repository in model.repositories]
    wanted = [
        folder / file.path
        for folder, repository in zip(folders, model.repositories, strict=True)
        for file in repository.files
    ]
    return folders, [path for path in wanted if not path.is_file()]
