"""Adam as the paper sets it, and a loop that can be killed at any time and goes on to the same bytes.

Under torchrun the loop is run by a team of processes: each computes the loss of its share of a step's rays, weighed by
the share's size, and gradients are added up before Adam. What comes out is what one process would have found, within
rounding; with the same number of processes it is the same bytes again (on CPUs).
"""

import functools
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from illuminerf.fields.recorded_steps import Numbers, RecordableLoss, RecordedSteps
from illuminerf.workflow.checkpoint import (
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)
from illuminerf.workflow.device import Precision
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.processes import ALONE, Team
from illuminerf.workflow.progress import step_progress


@dataclass(frozen=True)
class OptimiserConfig:
    """Adam (beta 0.9 and 0.99, epsilon 1e-15) with a logarithmic decay; supplement A.1."""

    num_steps: int = 1500
    """Steps (25 000 in the paper)."""
    rays_per_step: int = 512
    """Rays in a batch (2^13 in the paper preset)."""
    first_learning_rate: float = 5e-3
    """Learning rate after the warm-up (the paper's 5e-3)."""
    last_learning_rate: float = 5e-4
    """Learning rate of the last step (the paper's 5e-4)."""
    warmup_steps: int = 30
    """Steps of the cosine warm-up (500 of 25 000 in the paper)."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""
    precision: Precision = "float32"
    """bfloat16: layers of the radiance fields in autocast; hash grids, signed distances and losses stay float32."""

    def __post_init__(self) -> None:
        if min(self.num_steps, self.rays_per_step, self.checkpoint_every) < 1 or self.warmup_steps < 0:
            raise UserError("steps, rays per step and checkpoint interval must be positive", got=str(self))
        if not 0 < self.last_learning_rate <= self.first_learning_rate:
            raise UserError("the learning rate must decay to a positive value", got=str(self))

    @classmethod
    def paper(cls) -> "OptimiserConfig":
        """25 000 steps of 2^13 rays (of all processes together) with 500 steps of warm-up."""
        return cls(num_steps=25_000, rays_per_step=8192, warmup_steps=500, checkpoint_every=1000)

    def learning_rate(self, step: int) -> float:
        """Log-linear decay times the cosine warm-up, at a step counted from 0."""
        share = step / max(self.num_steps - 1, 1)
        decayed = self.first_learning_rate * (self.last_learning_rate / self.first_learning_rate) ** share
        if step >= self.warmup_steps:
            return decayed
        return decayed * 0.5 * (1 - math.cos(math.pi * (step + 1) / (self.warmup_steps + 1)))


class Stepper:
    """Adam on the loss of a step, one step at a time.

    On a GPU, by one process alone, steps of a `RecordableLoss` are recorded and replayed.

    Args:
        step_loss: see `fit`.
        records: False launches every step anew, for comparison.
    """

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        config: OptimiserConfig,
        step_loss: Callable[[int], tuple[Tensor, Numbers]],
        team: Team = ALONE,
        records: bool = True,
    ) -> None:
        self._parameters, self._config, self._step_loss, self._team = list(parameters), config, step_loss, team
        device = self._parameters[0].device
        self._recorded = None
        if records and device.type == "cuda" and team.is_alone and isinstance(step_loss, RecordableLoss):
            self._recorded = self._recording(step_loss, device)
        # a recording reads the rate from memory
        rate = torch.zeros((), device=device) if self._recorded else 0.0
        self.optimiser = torch.optim.Adam(
            self._parameters, rate, (0.9, 0.99), 1e-15, fused=True, capturable=self._recorded is not None
        )

    def run(self, first: int, end: int) -> Iterator[dict[str, float]]:
        """Take steps from `first` up to `end`; of each "loss", over all processes' rays, and the numbers beside it.

        Where steps are recorded, the fit is that after a yielded step only when it was the last.
        """
        if self._recorded is not None:
            yield from self._recorded.run(first, end)
            return
        for step in range(first, end):
            self._set_rate(step)
            numbers = self._compute(functools.partial(self._step_loss, step))
            names, values = list(numbers), list(numbers.values())
            yield dict(zip(names, torch.stack([v.double().to(values[0].device) for v in values]).tolist(), strict=True))

    def _recording(self, loss: RecordableLoss, device: torch.device) -> RecordedSteps:
        def prepare(step: int) -> Hashable:
            self._set_rate(step)
            return loss.prepare(step)

        return RecordedSteps(loss, prepare, lambda: self._compute(loss.loss), device)

    def _set_rate(self, step: int) -> None:
        rate = self._config.learning_rate(step)
        for group in self.optimiser.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def _compute(self, loss_of_step: Callable[[], tuple[Tensor, Numbers]]) -> Numbers:
        rays, team = self._config.rays_per_step, self._team
        loss, numbers = loss_of_step()
        total = team.mean(loss.detach(), rays)
        self.optimiser.zero_grad(set_to_none=True)
        (loss if team.is_alone else loss * team.weight(rays)).backward()
        team.sum_gradients(self._parameters)
        # Adam leaves everything as it is where a step did not fit its slots
        overflow = self._step_loss.slots.overflow if isinstance(self._step_loss, RecordableLoss) else None
        setattr(self.optimiser, "found_inf", overflow)  # noqa: B010 - where torch's fused Adam looks for it
        self.optimiser.step()
        return {"loss": total, **numbers}


def fit(
    module: nn.Module,
    config: OptimiserConfig,
    step_loss: Callable[[int], tuple[Tensor, Numbers]],
    checkpoint: Path,
    description: str,
    start: Callable[[], None] | None = None,
    team: Team = ALONE,
    state: Mapping[str, Tensor] | None = None,
) -> None:
    """Minimise `step_loss` over the parameters of `module` that require a gradient.

    Args:
        step_loss: from the step to the loss (its mean over this process's share of the rays) and numbers to show. All
            randomness must derive from the step, and what it remembers be in `state`, which is what makes a resumed fit
            equal to an uninterrupted one (on CPUs). A `RecordableLoss` is faster on a GPU.
        checkpoint: where state is kept; the caller deletes it when the artefact is whole.
        start: called once before the first step, not on resume.
        team: whose first process writes checkpoints.
        state: tensors that steps change in place, kept in checkpoints too.

    Raises:
        UserError: a step has fewer rays than there are processes.
    """
    rays = config.rays_per_step
    if rays < team.count:
        raise UserError("a step needs a ray per process", got=f"{rays} rays, {team.count} processes")
    parameters = {name: p for name, p in module.named_parameters() if p.requires_grad}
    state = state or {}
    stepper = Stepper(parameters.values(), config, step_loss, team)
    first = 0
    if team.agreed(checkpoint.exists()):
        first = _restore(checkpoint, parameters, stepper.optimiser, state)
    elif start is not None:
        start()
    team.start_equal(parameters.values())
    with step_progress(description, config.num_steps, first) as progress:
        while first < config.num_steps:
            end = min((first // config.checkpoint_every + 1) * config.checkpoint_every, config.num_steps)
            for step, numbers in enumerate(stepper.run(first, end), first):
                if not math.isfinite(numbers["loss"]):
                    raise FloatingPointError(f"the loss is {numbers['loss']} at step {step} of {description}")
                progress.advance(1, **numbers)
            first = end
            if first < config.num_steps and team.is_first:
                tensors: dict[str, Tensor] = {f"parameter.{name}": p for name, p in parameters.items()}
                tensors |= {f"state.{name}": tensor for name, tensor in state.items()}
                save_checkpoint(checkpoint, tensors | optimizer_tensors(stepper.optimiser), {"step": first})


def _restore(
    checkpoint: Path,
    parameters: Mapping[str, nn.Parameter],
    optimiser: torch.optim.Optimizer,
    state: Mapping[str, Tensor],
) -> int:
    device = next(iter(parameters.values())).device
    tensors, metadata = load_checkpoint(checkpoint, device)
    with torch.no_grad():
        for name, parameter in parameters.items():
            parameter.copy_(tensors[f"parameter.{name}"])
        for name, tensor in state.items():
            tensor.copy_(tensors[f"state.{name}"])
    restore_optimizer(optimiser, tensors)
    return int(metadata["step"])
