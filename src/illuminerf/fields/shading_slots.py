"""Which samples of a step are shaded: in as many slots as it has such samples, or in a fixed number of slots."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_HEADROOM = 1.25
_ROUND = 4096


class ShadingSlots:
    """Slots for the samples that are worth shading.

    How many there are differs from step to step, and the device must be asked before tensors of that size are made. A
    step that is recorded and replayed (`recorded_steps`) cannot ask: it gets a fixed number of slots. Those left over
    hold other samples with a weight of 0; where there are too few, `overflow` says so and the step is done again.
    Random numbers by points are then as many as slots: with another capacity they are others.

    Attributes:
        capacity: number of slots; None: as many as it takes.
        wanted: int64 [], how many samples were worth shading when last chosen.
        overflow: float32 [], 1 where they were more than slots, then or at any time since `forgive`, else 0; None
            without a capacity.
    """

    def __init__(self, capacity: int | None = None) -> None:
        self.capacity = capacity
        self.wanted = torch.tensor(0)
        self._overflow: Tensor | None = None

    @property
    def overflow(self) -> Float[Tensor, ""] | None:
        return None if self.capacity is None else self._overflow

    def forgive(self) -> None:
        """Count overflows anew."""
        if self._overflow is not None:
            self._overflow.zero_()

    def choose(
        self, is_worth: Bool[Tensor, "rays samples"]
    ) -> tuple[Int[Tensor, " points"], Float[Tensor, " points"] | None]:
        """Flat indices of the chosen samples, in order, and 1 for each that counts and 0 for others; None: all do."""
        flat = is_worth.reshape(-1)
        if self.capacity is None:
            chosen = flat.nonzero()[:, 0]
            self.wanted = torch.tensor(len(chosen), device=flat.device)
            return chosen, None
        place = flat.cumsum(0)
        self.wanted = place[-1]
        if self._overflow is None:
            self._overflow = torch.zeros((), device=flat.device)
        self._overflow.copy_(torch.maximum(self._overflow, (self.wanted > self.capacity).float()))
        # what is not worth it comes behind what is: different samples, for equal ones take turns in a gradient
        behind = self.wanted + torch.arange(1, len(flat) + 1, device=flat.device) - place
        slot = torch.where(flat, place, behind) - 1
        chosen = torch.zeros(self.capacity + 1, dtype=torch.int64, device=flat.device)
        chosen = chosen.scatter_(0, slot.clamp_max(self.capacity), torch.arange(len(flat), device=flat.device))
        counts = torch.arange(self.capacity, device=flat.device) < self.wanted
        return chosen[:-1], counts.float()

    def fit_to(self, wanted: int, most: int) -> None:
        """Make room for as many samples and a quarter more, unless there is about as much already.

        Args:
            most: samples of a step, of which no more than all can be worth it.
        """
        roomy = min(math.ceil(wanted * _HEADROOM / _ROUND) * _ROUND, most)
        if self.capacity is None or wanted > self.capacity or 2 * roomy < self.capacity:
            self.capacity = max(roomy, 1)
