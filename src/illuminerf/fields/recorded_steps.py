"""Steps of a fit on a GPU, recorded once and replayed (CUDA graphs): a thousand small launches become one.

At the sizes of the preset `gpu` a geometry step takes an H200 a third of the time that Python takes to launch it. A
recording repeats the same launches on the same memory. So whatever differs from step to step is written into tensors
(and the random generator) before, shapes are fixed (`ShadingSlots`), and nothing on the way asks the device for a
number. Nor does anybody between steps: numbers to show are fetched for a block of steps at a time.
"""

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from illuminerf.fields.shading_slots import ShadingSlots
from illuminerf.workflow.progress import say

Numbers = dict[str, Tensor]
_BLOCK = 16  # steps


@dataclass
class RecordableLoss:
    """The loss of a step in two parts, of which the second can be recorded.

    Attributes:
        prepare: from the step to the course that `loss` takes; writes what differs from step to step into tensors in
            place, without waiting for the device, and reseeds the generator. Steps of one course launch the same.
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
        loss: what is run; its slots are given a capacity.
        prepare: around `loss.prepare`.
        compute: all that a step computes, around `loss.loss`; must leave the device alone but for launches, and change
            nothing where the slots overflow.
    """

    def __init__(
        self,
        loss: RecordableLoss,
        prepare: Callable[[int], Hashable],
        compute: Callable[[], Numbers],
        device: torch.device,
    ) -> None:
        self._loss, self._prepare, self._compute, self._device = loss, prepare, compute, device
        self._stream = torch.cuda.Stream(device)
        self._tried: Hashable = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._names: list[str] = []
        self._row = torch.empty(0)
        self._is_impossible = False

    def run(self, first: int, end: int) -> Iterator[dict[str, float]]:
        """Run steps from `first` up to `end`; what each computed, by name. The last comes when all are done."""
        slots, step = self._loss.slots, first
        while step < end:
            slots.forgive()
            rows = torch.stack(list(self._block(step, end))).tolist()
            for row in rows:
                numbers = dict(zip(self._names, row, strict=True))
                wanted, overflow = numbers.pop("wanted"), numbers.pop("overflow")
                if not self._is_impossible and (overflow or row is rows[-1]):
                    slots.fit_to(round(wanted), self._loss.samples_per_step)
                if overflow:  # it and all after it changed nothing and are done again
                    break
                step += 1
                yield numbers

    def _block(self, first: int, end: int) -> Iterator[Tensor]:
        """Launch steps of one course, without waiting for them."""
        for step in range(first, min(first + _BLOCK, end)):
            course = (self._prepare(step), self._loss.slots.capacity)
            if self._has_recording(course, step):
                assert self._graph is not None
                self._graph.replay()
                yield self._row.clone()
                continue
            if step > first:
                return
            # what is compiled, loaded or cached at its first use must be so before a recording
            self._graph, self._tried = None, course
            self._stream.wait_stream(torch.cuda.current_stream(self._device))
            with torch.cuda.stream(self._stream):
                row = self._computed()
            torch.cuda.current_stream(self._device).wait_stream(self._stream)
            yield row
            return

    def _has_recording(self, course: Hashable, step: int) -> bool:
        """Of a course that has run before one is made where there is none. Else the step is ready to be launched."""
        if self._is_impossible or course != self._tried:
            return False
        if self._graph is None:
            self._record()
            if self._graph is None:
                self._prepare(step)
        return self._graph is not None

    def _record(self) -> None:
        """Record what a step computes; where it cannot be, none is tried again."""
        try:
            graph = torch.cuda.CUDAGraph()
            graph.register_generator_state(self._loss.generator)
            with torch.cuda.graph(graph, stream=self._stream):
                self._row = self._computed()
        except RuntimeError as error:
            say(f"steps are slower than they could be, as they cannot be recorded: {str(error).splitlines()[0]}")
            self._is_impossible, self._loss.slots.capacity = True, None
        else:
            self._graph = graph

    def _computed(self) -> Tensor:
        """What a step computes, in one tensor."""
        slots = self._loss.slots
        numbers = self._compute() | {"wanted": slots.wanted}
        numbers |= {"overflow": torch.zeros_like(slots.wanted) if slots.overflow is None else slots.overflow}
        self._names = list(numbers)
        return torch.stack([number.detach().double() for number in numbers.values()])
