"""A training run's examples: a pure function of (seed, step, number in the step), whoever asks for them.

So a run that was interrupted goes on with the very examples it would have seen, and two processes that split a step
see together what one alone would have seen. The next step's examples are made by threads meanwhile.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import torch

from illuminerf.diffusion.augmentation import AugmentationConfig, make_batch
from illuminerf.diffusion.cue_coding import CueCoding
from illuminerf.diffusion.objective import Batch, Draws, stratified_timesteps
from illuminerf.diffusion.training_items import TrainingItem
from illuminerf.workflow.device import derived_seed, torch_generator
from illuminerf.workflow.errors import UserError

_STEPS_AHEAD = 2


class Part(NamedTuple):
    """Examples that are computed at once."""

    batch: Batch
    draws: Draws


class Share(NamedTuple):
    """Which of a step's examples this process computes, and in how many parts."""

    process: int
    num_processes: int
    num_parts: int

    def examples(self, batch_size: int) -> list[range]:
        """The examples' numbers in the step, part by part.

        Raises:
            UserError: the step's examples cannot be split evenly.
        """
        pieces = self.num_processes * self.num_parts
        if batch_size % pieces:
            raise UserError(
                f"{batch_size} examples per step cannot be split evenly",
                got=f"{self.num_processes} processes with {self.num_parts} parts each",
                wanted=f"a batch size that is a multiple of {pieces}",
            )
        size = batch_size // pieces
        first = self.process * self.num_parts
        return [range((first + part) * size, (first + part + 1) * size) for part in range(self.num_parts)]


class ExampleStream:
    """The share of one process; `num_threads` of 0 makes examples only when asked."""

    def __init__(
        self,
        seed: int,
        batch_size: int,
        share: Share,
        augmentation: AugmentationConfig,
        coding: CueCoding,
        num_threads: int = 0,
    ) -> None:
        self.seed, self.batch_size, self.augmentation, self.coding = seed, batch_size, augmentation, coding
        self.parts = share.examples(batch_size)
        self.pool = ThreadPoolExecutor(num_threads) if num_threads else None
        self.ahead: dict[int, list[Future[Part]]] = {}

    def at(self, step: int, items_at: Callable[[int], list[TrainingItem] | None]) -> list[Part]:
        """The parts of `step`; `items_at` gives a step's items, or None where they are not to be loaded yet."""
        if self.pool is None:
            items = items_at(step)
            assert items is not None
            return [self._part(step, numbers, items) for numbers in self.parts]
        for soon in range(step, step + 1 + _STEPS_AHEAD):
            items = None if soon in self.ahead else items_at(soon)
            if items is not None:
                self.ahead[soon] = [self.pool.submit(self._part, soon, numbers, items) for numbers in self.parts]
        return [future.result() for future in self.ahead.pop(step)]

    def close(self) -> None:
        """Stop the threads."""
        if self.pool is not None:
            self.pool.shutdown(cancel_futures=True)

    def _part(self, step: int, numbers: range, items: list[TrainingItem]) -> Part:
        timesteps = stratified_timesteps(self.batch_size, torch_generator(self.seed, "timesteps", step))
        seeds = tuple(derived_seed(self.seed, "example", step, number) for number in numbers)
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        batch = make_batch(items, self.augmentation, generators, self.coding)
        return Part(batch, Draws(timesteps[numbers.start : numbers.stop], seeds))
