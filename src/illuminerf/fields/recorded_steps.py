"""Steps of a fit on a GPU, recorded once and replayed (CUDA graphs): a thousand small launches become one.

At the sizes of the preset `gpu` a geometry step takes an H200 7.5 ms to compute and Python 21 ms to launch. A recording
repeats the same launches on the same memory. So whatever differs from step to step is written into tensors (and the
random generator) before, shapes are fixed (`ShadingSlots`), and nothing on the way asks the device for a number.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from illuminerf.fields.shading_slots import ShadingSlots
from illuminerf.workflow.progress import say

Numbers = dict[str, Tensor]


@dataclass
class RecordableLoss:
    """The loss of a step in two parts, of which the second can be recorded.

    Attributes:
        prepare: from the step to the course that `loss` takes; writes what differs from step to step into tensors in
            place and reseeds the generator. Steps of one course make the same launches.
        loss: the loss (its mean over this process's share of the rays) and numbers to show, all left on the device.
        generator: all randomness of `loss`.
        samples_per_step: of which `slots` are chosen.
    """

    prepare: Callable[[int], Hashable]
    loss: Callable[[], tuple[Tensor, Numbers]]
    generator: torch.Generator
    samples_per_step: int
    slots: ShadingSlots = field(default_factory=ShadingSlots)

    def __call__(self, step: int) -> tuple[Tensor, Numbers]:
        """Both parts."""
        self.prepare(step)
        return self.loss()


class RecordedSteps:
    """Runs steps, from the second one of a course on by replaying the first's launches.

    Args:
        loss: what is run; `loss.slots` are given a capacity.
        compute: all that a step computes, around `loss.loss`; must leave the device alone but for launches.
    """

    def __init__(self, loss: RecordableLoss, compute: Callable[[], Numbers], device: torch.device) -> None:
        self._loss, self._compute, self._device = loss, compute, device
        self._stream = torch.cuda.Stream(device)
        self._tried: Hashable = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._numbers: Numbers = {}
        self._is_impossible = False

    def __call__(self, step: int) -> dict[str, float]:
        """Run one step; what it computed, by name."""
        slots = self._loss.slots
        while True:
            numbers = self._launched(step)
            names = [*numbers, "wanted"]
            assert slots.wanted is not None
            values = [*numbers.values(), slots.wanted]
            found = dict(zip(names, as_floats(values), strict=True))
            capacity, wanted = slots.capacity, round(found.pop("wanted"))
            if not self._is_impossible:
                slots.fit_to(wanted, self._loss.samples_per_step)
            if capacity is None or wanted <= capacity:
                return found

    def _launched(self, step: int) -> Numbers:
        course = (self._loss.prepare(step), self._loss.slots.capacity)
        if self._is_impossible or course != self._tried:
            # what is compiled, loaded or cached at its first use must be so before a recording
            self._forget()
            self._tried = course
            self._stream.wait_stream(torch.cuda.current_stream(self._device))
            with torch.cuda.stream(self._stream):
                numbers = self._compute()
            torch.cuda.current_stream(self._device).wait_stream(self._stream)
            return numbers
        if self._graph is None:
            try:
                self._record()
            except RuntimeError as error:
                say(f"steps are slower than they could be, as they cannot be recorded: {str(error).splitlines()[0]}")
                self._is_impossible, self._loss.slots.capacity = True, None
                return self._launched(step)
        assert self._graph is not None
        self._graph.replay()
        return self._numbers

    def _record(self) -> None:
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self._loss.generator)
        with torch.cuda.graph(graph, stream=self._stream):
            self._numbers = self._compute()
        self._graph = graph

    def _forget(self) -> None:
        self._graph, self._numbers = None, {}


def as_floats(values: list[Tensor]) -> list[float]:
    """Scalars from the device in one go."""
    return torch.stack([value.detach().double().to(values[0].device) for value in values]).tolist()
