"""The paper's trainer on a tiny base: frozen base, exact resume; two processes against one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from illuminerf.diffusion.controlled_base import ControlledBase
from illuminerf.diffusion.frozen_base import load_base
from illuminerf.diffusion.pretrained import pretrained_model
from illuminerf.stages import train_relighting_model
from illuminerf.stages.train_relighting_model import Config, ExecutionConfig, MonitoringConfig, Phase
from illuminerf.workflow.checkpoint import load_checkpoint
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import TINY, write_items
from tests.diffusion.tiny_base import tiny_config, write_base

ROOT = Path(__file__).parents[2]
SEED = 5


def control_config(base: Path, **changes: object) -> Config:
    settings = vars(Config.paper()) | {
        "control": tiny_config(base),
        "phases": (Phase(5, 32),),
        "batch_size": 4,
        "warm_up_steps": 2,
        "peak_learning_rate": 3e-3,
        "checkpoint_seconds": 0.0,
        "execution": ExecutionConfig(),
        "monitoring": MonitoringConfig(log_steps=1, validation_steps=100, validation_pairs=2, final_pairs=2),
        "device": "cpu",
        "seed": SEED,
    }
    return Config(**(settings | changes))  # type: ignore[arg-type]


def embedded_config(seed: int = SEED) -> Config:
    return Config(
        model=TINY,
        phases=(Phase(2, 16, "products"), Phase(3, 32)),
        batch_size=4,
        warm_up_steps=2,
        monitoring=MonitoringConfig(log_steps=1, validation_steps=100, validation_pairs=2, final_pairs=2),
        device="cpu",
        seed=seed,
    )


def curve(folder: Path) -> list[float]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line["loss"] for line in lines if line["kind"] == "train"]


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    return write_items(tmp_path / "pairs"), write_base(tmp_path / "base")


class StoppedError(Exception):
    """Stands in for a power cut."""


def test_interrupted_and_resumed_equals_uninterrupted(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs, base = folders
    config = control_config(base)
    whole = train_relighting_model.run(pairs, pairs, config, tmp_path / "whole")
    step = train_relighting_model._Training._one_step

    def stops_at_three(training: train_relighting_model._Training) -> dict[str, torch.Tensor]:
        if training.step == 3:
            raise StoppedError
        return step(training)

    with monkeypatch.context() as patch:
        patch.setattr(train_relighting_model._Training, "_one_step", stops_at_three)
        with pytest.raises(StoppedError):
            train_relighting_model.run(pairs, pairs, config, tmp_path / "parts")
    resumed = train_relighting_model.run(pairs, pairs, config, tmp_path / "parts")
    for name in ("controlnet", "conditioning"):
        path = f"{name}/diffusion_pytorch_model.safetensors"
        assert (whole / path).read_bytes() == (resumed / path).read_bytes()
    other = train_relighting_model.run(pairs, pairs, control_config(base, seed=SEED + 1), tmp_path / "other")
    assert (whole / path).read_bytes() != (other / path).read_bytes()


def test_the_control_learns_and_the_base_stays(folders: tuple[Path, Path], tmp_path: Path) -> None:
    pairs, base = folders
    before = load_base(base).state_dict()
    config = control_config(base, phases=(Phase(30, 32),), batch_size=8, average_decay=0.5)
    out = train_relighting_model.run(pairs, pairs, config, tmp_path / "out")
    losses = curve(out)
    assert losses[0] == pytest.approx(1.0, abs=0.4)  # a random base predicts about nothing of unit noise
    assert sum(losses[-5:]) < 0.97 * sum(losses[:5])
    model = pretrained_model(out)
    assert isinstance(model, ControlledBase)
    assert all(torch.equal(value, before[name]) for name, value in model.base.state_dict().items())
    assert any(parameter.abs().max() > 0 for parameter in model.control.controlnet_down_blocks.parameters())
    stored = load_checkpoint(out / "training.safetensors")[0]
    assert not [name for name in stored if ".base." in name]
    trained = sum(parameter.requires_grad for parameter in model.parameters())
    assert len({name.split(".")[1] for name in stored if name.startswith("optimizer.")}) == trained
    assert (out / "validation" / "000030.png").exists()


def test_gradient_checkpointing_changes_no_more_than_rounding(folders: tuple[Path, Path], tmp_path: Path) -> None:
    pairs, base = folders
    plain = curve(train_relighting_model.run(pairs, pairs, control_config(base), tmp_path / "plain"))
    execution = ExecutionConfig(checkpoints_gradients=True)
    config = control_config(base, execution=execution, accumulation=2)
    again = curve(train_relighting_model.run(pairs, pairs, config, tmp_path / "checkpointed"))
    assert again == pytest.approx(plain, rel=1e-4)


def test_a_base_that_is_missing_is_explained(folders: tuple[Path, Path], tmp_path: Path) -> None:
    config = control_config(tmp_path, control=tiny_config("someone/somewhere"))
    with pytest.raises(UserError, match="models download paper --base someone/somewhere"):
        train_relighting_model.run(folders[0], folders[0], config, tmp_path / "out")


def test_paper_settings() -> None:
    paper = Config.paper("x/y")
    assert (paper.num_steps, paper.batch_size, paper.peak_learning_rate, paper.warm_up_steps) == (
        150_000,
        512,
        1e-4,
        1000,
    )
    assert paper.phase_at(149_999).size == 512 and paper.final_share == 0
    assert not paper.control.conditioning.hears_text and paper.control.conditioning.tokens.out_channels == 1024


SCRIPT = """
import sys
from pathlib import Path
import torch
from illuminerf.stages import train_relighting_model
from illuminerf.stages.train_relighting_model import ExecutionConfig
from tests.stages.test_train_control import control_config, embedded_config
pairs, base, out = map(Path, sys.argv[1:])
spread = control_config(base, accumulation=2, execution=ExecutionConfig(checkpoints_gradients=True))
train_relighting_model.run(pairs, pairs, spread, out / "control")
train_relighting_model.run(pairs, pairs, embedded_config(), out / "embedded")
assert torch.distributed.get_world_size() == 2
"""


def test_two_processes_have_the_loss_curve_of_one(folders: tuple[Path, Path], tmp_path: Path) -> None:
    pairs, base = folders
    (tmp_path / "script.py").write_text(SCRIPT)
    launch = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-port", "0"]
    environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*launch, "--standalone", str(tmp_path / "script.py"), str(pairs), str(base), str(tmp_path / "two")],
        env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    for name, config, other in (
        ("control", control_config(base), control_config(base, seed=SEED + 1)),
        ("embedded", embedded_config(), embedded_config(SEED + 1)),
    ):
        two = curve(tmp_path / "two" / name)
        one = curve(train_relighting_model.run(pairs, pairs, config, tmp_path / "one" / name))
        another = curve(train_relighting_model.run(pairs, pairs, other, tmp_path / "another" / name))
        assert len(two) == 5
        assert two == pytest.approx(one, rel=1e-5)
        assert another != pytest.approx(one, rel=1e-2)
        assert (tmp_path / "two" / name / "DONE").exists()
