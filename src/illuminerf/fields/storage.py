"""A fitted field on disk: field.safetensors and field.json."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.config import from_json, to_json
from illuminerf.workflow.errors import UserError

_FORMAT = 1
_MOST = 64


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


def _check_sizes(folder: Path, config: FieldConfig, tensors: dict[str, Tensor]) -> None:
    """UserError where field.json is not of these tensors, before memory is spent by its word."""
    too_deep = max(grid.num_levels for grid in _grids(config)) > _MOST or config.appearance.num_hidden_layers > _MOST
    if not too_deep:
        try:
            with torch.device("meta"):
                wanted = {name: tensor.shape for name, tensor in RadianceField(config).state_dict().items()}
        except (RuntimeError, TypeError, ValueError, ArithmeticError) as error:  # widths below 0, or beyond 64 bits
            reason = str(error).partition("\n")[0]
            raise UserError(
                f"{folder}/field.json is not that of a field",
                got=reason,
                fix="run the stage that makes the field again",
            ) from error
        different = [name for name, shape in wanted.items() if name not in tensors or tensors[name].shape != shape]
    if too_deep or different:
        raise UserError(
            f"{folder}/field.safetensors does not fit field.json",
            got="more than 64 levels or layers" if too_deep else f"another {different[0]}",
            fix="run the stage that makes the field again",
        )


def _grids(config: FieldConfig) -> tuple[HashGridConfig, ...]:
    return (config.surface.grid, config.surface.normal_grid, config.appearance.grid, config.proposal.grid)


def load_field(folder: Path, device: torch.device | str = "cpu") -> StoredField:
    """Read what `save_field` wrote, in evaluation mode.

    Raises:
        UserError: missing, corrupt, of another format, or sizes that do not fit the tensors.
    """
    header = read_json(folder / "field.json")
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        raise UserError(f"{folder} holds no field of this version", wanted=f"format {_FORMAT}")
    config = from_json(FieldConfig, header.get("field", {}))
    tensors, _ = load_checkpoint(folder / "field.safetensors")
    _check_sizes(folder, config, tensors)
    field = RadianceField(config)
    try:
        cells = OccupiedCells(tensors.pop("occupied_cells").bool().to(device))
        latents = tensors.pop("latents", None)
        field.load_state_dict(tensors)
    except (KeyError, RuntimeError) as error:
        raise UserError(
            f"{folder}/field.safetensors does not fit field.json", got=str(error).splitlines()[0]
        ) from error
    return StoredField(field.to(device).eval(), cells, None if latents is None else latents.to(device))
