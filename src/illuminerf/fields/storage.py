"""A fitted field on disk: field.safetensors and field.json."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.config import from_json, to_json
from illuminerf.workflow.errors import UserError

_FORMAT = 1


@dataclass
class StoredField:
    """A field, the cells it occupies, and (for a latent NeRF) the latent codes [images, latent] of its training."""

    field: RadianceField
    cells: OccupiedCells
    latents: Tensor | None = None


def save_field(folder: Path, stored: StoredField) -> None:
    """Write the field; field.json, written last, holds its sizes."""
    tensors = dict(stored.field.state_dict())
    tensors["occupied_cells"] = stored.cells.cells.to(torch.uint8)
    if stored.latents is not None:
        tensors["latents"] = stored.latents
    save_checkpoint(folder / "field.safetensors", tensors, {"format": _FORMAT})
    write_json(folder / "field.json", {"format": _FORMAT, "field": to_json(stored.field.config)})


def load_field(folder: Path, device: torch.device | str = "cpu") -> StoredField:
    """Read what `save_field` wrote, in evaluation mode.

    Raises:
        UserError: missing, corrupt, of another format, or sizes that do not fit the tensors.
    """
    header = read_json(folder / "field.json")
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        raise UserError(f"{folder} holds no field of this version", wanted=f"format {_FORMAT}")
    field = RadianceField(from_json(FieldConfig, header.get("field", {})))
    tensors, _ = load_checkpoint(folder / "field.safetensors")
    try:
        cells = OccupiedCells(tensors.pop("occupied_cells").bool().to(device))
        latents = tensors.pop("latents", None)
        field.load_state_dict(tensors)
    except (KeyError, RuntimeError) as error:
        raise UserError(
            f"{folder}/field.safetensors does not fit field.json", got=str(error).splitlines()[0]
        ) from error
    return StoredField(field.to(device).eval(), cells, None if latents is None else latents.to(device))
