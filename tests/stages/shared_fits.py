"""Tiny fits that a team of processes runs together: a script for torchrun or any launcher.

    shared_fits.py CAPTURE RELIT OUT         both stages; geometry is stopped and gone on with on the way
    shared_fits.py CAPTURE RELIT OUT dies    the last process ends without a word in the third step

The first process writes OUT/<stage>.json, the losses by step, beside the artefacts. Each process writes OUT/ended_<its
number>.json as it ends: whether the process group was closed by then.
"""

import atexit
import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

from torch import Tensor, distributed

from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.stages import estimate_geometry, fit_latent_nerf
from illuminerf.workflow.processes import Team
from illuminerf.workflow.progress import StepProgress
from tests.stages.conftest import TINY_GEOMETRY

# three rays make shares of one and of two
_OPTIMISER = OptimiserConfig(num_steps=7, rays_per_step=3, warmup_steps=2, checkpoint_every=4)
GEOMETRY = replace(TINY_GEOMETRY, optimiser=_OPTIMISER, mesh_resolution=16)
LATENT_NERF = fit_latent_nerf.Config(optimiser=_OPTIMISER, device="cpu")
STOPS_AT = 5


@contextmanager
def recorded_losses() -> Iterator[list[float]]:
    """What fits show of their loss, step by step."""
    losses: list[float] = []
    advance = StepProgress.advance

    def records(progress: StepProgress, steps: int = 1, **numbers: float) -> None:
        losses.extend([numbers["loss"]] if "loss" in numbers else [])
        advance(progress, steps, **numbers)

    with mock.patch.object(StepProgress, "advance", records):
        yield losses


@contextmanager
def ended_in(step_of_end: int, without_a_word: bool) -> Iterator[None]:
    """End this process, or its fit, in one step."""
    learning_rate = OptimiserConfig.learning_rate

    def ends(config: OptimiserConfig, step: int) -> float:
        if step == step_of_end:
            if without_a_word:
                os._exit(7)
            raise KeyboardInterrupt
        return learning_rate(config, step)

    with mock.patch.object(OptimiserConfig, "learning_rate", ends):
        yield


def averages_wrongly(team: Team, parameters: Iterable[Tensor]) -> None:
    """Every share counts the same, as if the mean of means were the mean."""
    kept = [parameter for parameter in parameters if parameter.grad is not None]
    for parameter in kept:
        assert parameter.grad is not None
        parameter.grad /= team.weight(_OPTIMISER.rays_per_step) * team.count
    _sum_gradients(team, kept)


_sum_gradients = Team.sum_gradients


def fits(capture: Path, relit: Path, out: Path) -> None:
    """Both stages, and geometry again with wrong weights."""
    with recorded_losses() as losses:
        try:
            with ended_in(STOPS_AT, without_a_word=False):
                estimate_geometry.run(capture, GEOMETRY, out / "geometry")
        except KeyboardInterrupt:
            estimate_geometry.run(capture, GEOMETRY, out / "geometry")
        _write(out / "geometry.json", losses)
        fit_latent_nerf.run(out / "geometry", capture, relit, LATENT_NERF, out / "latent_nerf")
        _write(out / "latent_nerf.json", losses)
        with mock.patch.object(Team, "sum_gradients", averages_wrongly):
            estimate_geometry.run(capture, GEOMETRY, out / "wrong")
        _write(out / "wrong.json", losses)
    estimate_geometry.run(capture, GEOMETRY, out / "geometry")  # finished: every process loads it


def _write(path: Path, losses: list[float]) -> None:
    if os.environ["RANK"] == "0":
        path.write_text(json.dumps(losses))
    losses.clear()


def writes_how_it_ended(out: Path) -> None:
    """Called last as this process ends: functions that end a process run in the reverse order of their registration."""
    is_closed = not distributed.is_initialized()
    (out / f"ended_{os.environ['RANK']}.json").write_text(json.dumps(is_closed))


if __name__ == "__main__":
    folders = [Path(argument) for argument in sys.argv[1:4]]
    atexit.register(writes_how_it_ended, folders[2])
    if "dies" not in sys.argv:
        fits(*folders)
    elif os.environ["RANK"] == "0":
        estimate_geometry.run(folders[0], GEOMETRY, folders[2] / "geometry")
    else:
        with ended_in(2, without_a_word=True):
            estimate_geometry.run(folders[0], GEOMETRY, folders[2] / "geometry")
