"""Random numbers of one step of a fit, which a team of processes shares."""

import torch
from jaxtyping import Float
from torch import Tensor

from illuminerf.workflow.processes import ALONE, Team


class StepDraws:
    """Random numbers by rays and by points.

    Each process of a team draws those of the whole step and keeps what belongs to its own rays, so that all together
    use the numbers that one process alone would.

    Args:
        generator: in the same state in every process.
        num_rays: rays of the step, all processes' together.
    """

    def __init__(self, generator: torch.Generator, num_rays: int, team: Team = ALONE) -> None:
        self._generator, self._num_rays, self._team = generator, num_rays, team
        self.own = team.own(num_rays)

    def uniform(self, columns: int) -> Float[Tensor, "rays columns"]:
        """Numbers in [0, 1) for each of this process's rays."""
        device = self._generator.device
        return torch.rand(self._num_rays, columns, generator=self._generator, device=device)[self.own]

    def normal(self, num_points: int, columns: int) -> Float[Tensor, "points columns"]:
        """Normal numbers for each of this process's points, which are in the order of the rays."""
        counts, device = self._team.counts(num_points), self._generator.device
        whole = torch.randn(sum(counts), columns, generator=self._generator, device=device)
        start = sum(counts[: self._team.index])
        return whole[start : start + num_points]
