"""The state of a training run: averaged weights, learning rate, exact resume."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor, nn

from illuminerf.workflow.checkpoint import (
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)
from illuminerf.workflow.errors import UserError


def trained_tensors(model: nn.Module) -> dict[str, Tensor]:
    """The model's state without what is frozen: neither averaged nor written into checkpoints."""
    frozen: tuple[str, ...] = getattr(model, "frozen_prefixes", ())
    return {name: value for name, value in model.state_dict().items() if not name.startswith(frozen)}


class WeightAverage:
    """Exponential moving average of a model's parameters and buffers; the decay of each warms up with the steps that it
    has been trained for, so that what begins to learn late does not stay near its random beginning."""

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay = decay
        self.tensors = {name: value.detach().clone() for name, value in trained_tensors(model).items()}

    @torch.no_grad()
    def update(self, model: nn.Module, steps_trained: Callable[[str], int]) -> None:
        """Move towards the model after a step; `steps_trained` says how many steps a tensor had been trained before."""
        for name, value in trained_tensors(model).items():
            steps = max(0, steps_trained(name))
            self.tensors[name].lerp_(value, 1 - min(self.decay, (1 + steps) / (10 + steps)))

    @contextmanager
    def inside(self, model: nn.Module) -> Iterator[None]:
        """Put the averages into the model, ready to sample, and take them out again, bit by bit, at the end."""
        current = {name: value.detach().clone() for name, value in trained_tensors(model).items()}
        was_training = model.training
        _copy_into(model, self.tensors)
        model.eval()
        try:
            yield
        finally:
            _copy_into(model, current)
            model.train(was_training)


@torch.no_grad()
def _copy_into(model: nn.Module, tensors: dict[str, Tensor]) -> None:
    for name, value in trained_tensors(model).items():
        value.copy_(tensors[name])


def learning_rate(step: int, peak: float, warm_up_steps: int, num_steps: int, final_share: float) -> float:
    """Linear warm-up from 0, then constant, then over the last `final_share` of all steps linearly to 0."""
    rise = (step + 1) / max(1, warm_up_steps)
    fall = (num_steps - step) / max(1.0, final_share * num_steps)
    return peak * min(1.0, rise, fall)


def save_training(
    path: Path, model: nn.Module, average: WeightAverage, optimizer: torch.optim.Optimizer, step: int
) -> None:
    """Write everything a run needs to go on as if never stopped; randomness derives from the step."""
    tensors: dict[str, Tensor] = {f"model.{name}": value for name, value in trained_tensors(model).items()}
    tensors |= {f"average.{name}": value for name, value in average.tensors.items()}
    save_checkpoint(path, tensors | optimizer_tensors(optimizer), {"step": step})


def restore_training(path: Path, model: nn.Module, average: WeightAverage, optimizer: torch.optim.Optimizer) -> int:
    """Put back what `save_training` wrote; returns the number of finished steps.

    Raises:
        UserError: the checkpoint is missing, corrupt or of another model.
    """
    tensors, metadata = load_checkpoint(path)
    stored = _under("model.", tensors)
    if {name: value.shape for name, value in stored.items()} != {k: v.shape for k, v in average.tensors.items()}:
        raise UserError(f"{path} is of another model", fix="delete its folder and run again")
    _copy_into(model, stored)
    for name, value in _under("average.", tensors).items():
        average.tensors[name].copy_(value)
    restore_optimizer(optimizer, tensors)
    _match_layouts(optimizer)
    return int(metadata["step"])


def _match_layouts(optimizer: torch.optim.Optimizer) -> None:
    """Give moments their parameter's memory layout: files hold plain order, fused kernels walk both as flat memory."""
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if value.shape == parameter.shape:
                state[name] = torch.empty_like(parameter).copy_(value)


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
