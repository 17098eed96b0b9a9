"""Checkpoints of running fits: safetensors with a JSON header, written atomically."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from illuminerf.workflow.atomic import write_bytes
from illuminerf.workflow.errors import UserError


def save_checkpoint(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write `tensors` and JSON-able `metadata` to one safetensors file, whole or not at all."""
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_bytes(path, save(contiguous, metadata={"illuminerf": json.dumps(metadata, sort_keys=True)}))


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_checkpoint` wrote: (tensors by name, metadata).

    Raises:
        UserError: the file is missing or corrupt.
    """
    try:
        with safe_open(str(path), framework="pt", device=str(device)) as stream:
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
            header = stream.metadata() or {}
        metadata = json.loads(header.get("illuminerf", "{}"))
        if not isinstance(metadata, dict):
            raise ValueError(f"a header that is {type(metadata).__name__}")
        return tensors, metadata
    except FileNotFoundError as error:
        raise UserError(f"{path} is missing", fix="run the stage that makes it again") from error
    except (SafetensorError, ValueError, LookupError, TypeError, RuntimeError, RecursionError, OSError) as error:
        raise UserError(f"{path} is corrupt", got=str(error), fix="delete its folder and run again") from error


def optimizer_tensors(optimizer: torch.optim.Optimizer, prefix: str = "optimizer") -> dict[str, Tensor]:
    """The optimiser's state as flat named tensors, so that it fits into a safetensors file."""
    return {
        f"{prefix}.{index}.{name}": torch.as_tensor(value)
        for index, state in optimizer.state_dict()["state"].items()
        for name, value in state.items()
    }


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor], prefix: str = "optimizer") -> None:
    """Put back what `optimizer_tensors` took."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith(f"{prefix}."):
            index, key = name.removeprefix(f"{prefix}.").split(".", 1)
            state.setdefault(int(index), {})[key] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
