"""Examples are a function of seed, step and number, whoever makes them and when."""

from pathlib import Path

import pytest
import torch

from illuminerf.diffusion.augmentation import AugmentationConfig
from illuminerf.diffusion.example_stream import ExampleStream, Part, Share
from illuminerf.diffusion.training_items import load_items
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import write_items


def joined(parts: list[Part]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    noise = torch.cat([part.draws.noise((2, 3)) for part in parts])
    return torch.cat([part.batch.target for part in parts]), torch.cat([part.draws.timesteps for part in parts]), noise


def same(first: list[Part], second: list[Part]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(joined(first), joined(second), strict=True))


def test_shares_of_a_step_cover_it_once() -> None:
    numbers = [n for process in range(3) for part in Share(process, 3, 2).examples(24) for n in part]
    assert numbers == list(range(24))
    with pytest.raises(UserError, match="multiple of 6"):
        Share(0, 3, 2).examples(20)


def test_whoever_makes_them_the_examples_are_the_same(tmp_path: Path) -> None:
    items = load_items(write_items(tmp_path), 32)

    def parts(step: int, share: Share, seed: int = 7, num_threads: int = 0, first: int = 0) -> list[Part]:
        stream = ExampleStream(seed, 8, share, AugmentationConfig(), "power", num_threads)
        for earlier in range(first, step):
            stream.at(earlier, lambda _: items)
        made = stream.at(step, lambda _: items)
        stream.close()
        return made

    alone = parts(5, Share(0, 1, 1), first=5)
    assert same(parts(5, Share(0, 1, 4), first=5), alone)
    assert same(parts(5, Share(0, 2, 2), first=5) + parts(5, Share(1, 2, 2), first=5), alone)
    assert same(parts(5, Share(0, 1, 1), num_threads=3, first=3), alone)
    assert not same(parts(6, Share(0, 1, 1), first=6), alone)
    assert not same(parts(5, Share(0, 1, 1), seed=8, first=5), alone)
    assert sorted((joined(alone)[1] // 125).tolist()) == list(range(8))  # one timestep per stratum of the whole step


def test_items_that_are_not_loaded_yet_are_waited_for(tmp_path: Path) -> None:
    items = load_items(write_items(tmp_path), 32)
    stream = ExampleStream(0, 2, Share(0, 1, 1), AugmentationConfig(), "power", num_threads=1)
    asked: list[int] = []

    def items_at(step: int) -> list | None:
        asked.append(step)
        return items if step < 2 else None

    stream.at(0, items_at)
    stream.at(1, items_at)
    assert asked == [0, 1, 2, 2, 3]
    asked_for = ExampleStream(0, 2, Share(0, 1, 1), AugmentationConfig(), "power")
    assert same(stream.at(2, lambda _: items), asked_for.at(2, lambda _: items))
    stream.close()
