"""Where things run and where randomness comes from."""

import hashlib
from contextlib import AbstractContextManager, nullcontext
from typing import Literal

import numpy as np
import torch

from illuminerf.workflow.errors import UserError


def resolve_device(name: str) -> torch.device:
    """Turn "auto", "cpu" or "cuda" (or "cuda:1") into a device.

    Raises:
        UserError: CUDA is asked for where there is none, or the name is unknown.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cpu":
        return torch.device("cpu")
    if name == "cuda" or name.startswith("cuda:"):
        if not torch.cuda.is_available():
            raise UserError(
                "CUDA was asked for, but this PyTorch sees no CUDA device",
                got=f"torch {torch.__version__}",
                fix="use --device cpu (or auto), or install a CUDA build of PyTorch and check nvidia-smi",
            )
        return torch.device(name)
    raise UserError("unknown device", got=repr(name), wanted="auto, cpu or cuda")


Precision = Literal["float32", "bfloat16"]


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager[object]:
    """Run matrix products and convolutions in bfloat16 where that is asked for; weights stay float32."""
    if precision == "float32":
        return nullcontext()
    return torch.autocast(device.type, torch.bfloat16)


def full_precision(device: torch.device) -> AbstractContextManager[object]:
    """No autocast inside, for the few operations whose results are targets or images."""
    return nullcontext() if device.type == "meta" else torch.autocast(device.type, enabled=False)


def derived_seed(seed: int, *names: object) -> int:
    """A 63-bit seed for one named random stream, e.g. (7, "relight", view, sample): streams never collide."""
    text = "\0".join([str(seed), *map(str, names)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def torch_generator(seed: int, *names: object, device: torch.device | str = "cpu") -> torch.Generator:
    """A seeded torch generator for one named stream."""
    return torch.Generator(device=device).manual_seed(derived_seed(seed, *names))


def numpy_generator(seed: int, *names: object) -> np.random.Generator:
    """A seeded numpy generator for one named stream."""
    return np.random.default_rng(derived_seed(seed, *names))
