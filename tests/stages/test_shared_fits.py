"""Fits that two processes share find what one process finds; a process that dies does not leave the other waiting."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from illuminerf.data.capture import load_capture
from illuminerf.fields.optimisation import OptimiserConfig, fit
from illuminerf.scene.images import write_png
from illuminerf.stages import estimate_geometry, fit_latent_nerf
from illuminerf.workflow.artefact import read_metrics, verify
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.processes import Team, join
from tests.stages.shared_fits import GEOMETRY, LATENT_NERF, STOPS_AT, recorded_losses

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tests" / "stages" / "shared_fits.py"
ENVIRONMENT = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def relit(sphere_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("relit")
    for view, image in enumerate(load_capture(sphere_capture).views.premultiplied()):
        for sample, gain in enumerate((0.6, 1.4)):
            write_png(folder / "samples" / f"{view:03d}_{sample:02d}.png", np.clip(0.6 * gain * image, 0, 1))
    return folder


@pytest.fixture(scope="module")
def two(sphere_capture: Path, relit: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("two")
    launch = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone"]
    command = [*launch, str(SCRIPT), str(sphere_capture), str(relit), str(out)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stderr.count("fit latent NeRF: 7/7") == 1, "one process speaks for all"
    return out


@pytest.fixture(scope="module")
def one(sphere_capture: Path, relit: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list]]:
    out = tmp_path_factory.mktemp("one")
    with recorded_losses() as of_geometry:
        estimate_geometry.run(sphere_capture, GEOMETRY, out / "geometry")
    with recorded_losses() as of_latents:
        fit_latent_nerf.run(out / "geometry", sphere_capture, relit, LATENT_NERF, out / "latent_nerf")
    return out, {"geometry": of_geometry, "latent_nerf": of_latents}


def furthest(first: Path, second: Path) -> float:
    """Largest difference between the parameters of two fields."""
    ours, theirs = load_file(first / "field.safetensors"), load_file(second / "field.safetensors")
    assert ours.keys() == theirs.keys()
    return max(float((ours[name].double() - theirs[name].double()).abs().max()) for name in ours)


@pytest.mark.parametrize("stage", ["geometry", "latent_nerf"])
def test_two_processes_find_what_one_finds(two: Path, one: tuple[Path, dict[str, list]], stage: str) -> None:
    alone, losses = one
    curve = json.loads((two / f"{stage}.json").read_text())
    if stage == "geometry":  # stopped, and gone on with from the checkpoint: one step was computed twice
        again = GEOMETRY.optimiser.checkpoint_every
        assert curve[again] == curve[STOPS_AT]
        del curve[again]
    # rounding of one step is 2e-7 and grows from step to step: up to 1.1e-5 after seven, over six seeds
    assert curve == pytest.approx(losses[stage], rel=2e-5)
    assert furthest(two / stage, alone / stage) < 2e-5
    verify(two / stage)
    assert not (two / stage / "checkpoint.safetensors").exists()


def test_the_recorded_quality_is_that_of_all_rays(two: Path, one: tuple[Path, dict[str, list]]) -> None:
    ours, theirs = (read_metrics(out / "latent_nerf")["train_psnr"] for out in (two, one[0]))
    assert ours == pytest.approx(theirs, rel=1e-5)


def test_a_mean_of_means_is_noticed(two: Path, one: tuple[Path, dict[str, list]]) -> None:
    """The guard: shares of one and of two rays that count the same."""
    wrong = json.loads((two / "wrong.json").read_text())
    assert wrong[0] == pytest.approx(one[1]["geometry"][0], rel=2e-6), "nothing was learnt yet"
    assert wrong[-1] != pytest.approx(one[1]["geometry"][-1], rel=1e-4)
    assert furthest(two / "wrong", one[0] / "geometry") > 1e-3


def test_the_group_is_closed_before_the_interpreter_ends(two: Path) -> None:
    """A thread of an open one would abort the process now and then, long after its work was done."""
    assert [json.loads((two / f"ended_{rank}.json").read_text()) for rank in range(2)] == [True, True]


def test_a_dead_process_leaves_no_other_waiting(sphere_capture: Path, relit: Path, tmp_path: Path) -> None:
    """Without torchrun, which would end the other one too."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = []
    for rank in range(2):
        where = {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        command = [sys.executable, str(SCRIPT), str(sphere_capture), str(relit), str(tmp_path), "dies"]
        processes.append(subprocess.Popen(command, env=ENVIRONMENT | where, stderr=subprocess.PIPE, text=True))
    try:
        assert processes[1].wait(timeout=240) == 7
        _, said = processes[0].communicate(timeout=60)
    finally:
        for process in processes:
            process.kill()
    assert processes[0].returncode not in (0, -9) and "another process of this run has ended" in said
    assert not (tmp_path / "geometry" / "DONE").exists()
    assert not json.loads((tmp_path / "ended_0.json").read_text()), "who waits for a dead process may wait for ever"


def test_shares_cover_everything_once() -> None:
    for total, count in ((3, 2), (8192, 7), (5, 5)):
        teams = [Team(index, count) for index in range(count)]
        numbers = [number for team in teams for number in range(total)[team.own(total)]]
        assert numbers == list(range(total))
        assert sum(team.weight(total) for team in teams) == pytest.approx(1)
        sizes = {len(range(total)[team.own(total)]) for team in teams}
        assert max(sizes) - min(sizes) <= 1


def test_wrong_launches_are_user_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = OptimiserConfig(rays_per_step=2)
    with pytest.raises(UserError, match="ray per process"):
        fit(torch.nn.Linear(1, 1), few, lambda step: (torch.zeros(()), {}), tmp_path / "none", "", team=Team(0, 3))
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(UserError, match="GPU of its own"):
        join("auto")
