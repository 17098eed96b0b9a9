"""The state of a training run: averaged weights, learning rate, exact resume."""

from pathlib import Path

import torch
from torch import Tensor, nn

from illuminerf.workflow.checkpoint import (
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)


class WeightAverage:
    """Exponential moving average of a model's parameters and buffers; the decay warms up with the steps."""

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay = decay
        self.tensors = {name: value.detach().clone() for name, value in model.state_dict().items()}

    @torch.no_grad()
    def update(self, model: nn.Module, step: int) -> None:
        """Move towards the model after optimisation step `step` (0, 1, ...)."""
        decay = min(self.decay, (1 + step) / (10 + step))
        for name, value in model.state_dict().items():
            self.tensors[name].lerp_(value, 1 - decay)


def learning_rate(step: int, peak: float, warm_up_steps: int, num_steps: int, final_share: float) -> float:
    """Linear warm-up from 0, then constant, then over the last `final_share` of all steps linearly to 0."""
    rise = (step + 1) / max(1, warm_up_steps)
    fall = (num_steps - step) / max(1.0, final_share * num_steps)
    return peak * min(1.0, rise, fall)


def save_training(
    path: Path, model: nn.Module, average: WeightAverage, optimizer: torch.optim.Optimizer, step: int
) -> None:
    """Write everything a run needs to go on as if never stopped; randomness derives from the step."""
    tensors: dict[str, Tensor] = {f"model.{name}": value for name, value in model.state_dict().items()}
    tensors |= {f"average.{name}": value for name, value in average.tensors.items()}
    save_checkpoint(path, tensors | optimizer_tensors(optimizer), {"step": step})


def restore_training(path: Path, model: nn.Module, average: WeightAverage, optimizer: torch.optim.Optimizer) -> int:
    """Put back what `save_training` wrote; returns the number of finished steps."""
    tensors, metadata = load_checkpoint(path)
    model.load_state_dict(_under("model.", tensors))
    average.tensors = _under("average.", tensors)
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
