"""Training: interrupted and resumed equals uninterrupted; the artefact is a loadable model."""

import json
import sys
from pathlib import Path

import pytest
import torch

from illuminerf.diffusion.controlled_base import ControlledBaseConfig
from illuminerf.diffusion.objective import LossWeights
from illuminerf.diffusion.relighting_model import load_model
from illuminerf.stages import train_relighting_model
from illuminerf.stages.train_relighting_model import Config, ExecutionConfig, MonitoringConfig, Phase
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import TINY, write_items

CONFIG = Config(
    model=TINY,
    phases=(Phase(2, 16, "products"), Phase(1, 32, "diffusion"), Phase(3, 32)),
    batch_size=2,
    accumulation=2,
    warm_up_steps=2,
    checkpoint_seconds=0.0,
    monitoring=MonitoringConfig(log_steps=1, validation_steps=4, validation_pairs=2, final_pairs=2),
    device="cpu",
    seed=5,
)


class StoppedError(Exception):
    """Stands in for a power cut."""


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_model(folder).state_dict()


def test_interrupted_and_resumed_equals_uninterrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = write_items(tmp_path / "pairs")
    whole = train_relighting_model.run(pairs, pairs, CONFIG, tmp_path / "whole")

    step = train_relighting_model._Training._one_step

    def stops_at_three(training: train_relighting_model._Training) -> dict[str, torch.Tensor]:
        if training.step == 3:
            raise StoppedError
        return step(training)

    with monkeypatch.context() as patch:
        patch.setattr(train_relighting_model._Training, "_one_step", stops_at_three)
        with pytest.raises(StoppedError):
            train_relighting_model.run(pairs, pairs, CONFIG, tmp_path / "parts")
    assert not (tmp_path / "parts" / "DONE").exists()
    resumed = train_relighting_model.run(pairs, pairs, CONFIG, tmp_path / "parts")

    expected, found = weights(whole), weights(resumed)
    assert all(torch.equal(value, found[name]) for name, value in expected.items())
    assert (whole / "metrics.jsonl").read_bytes() == (resumed / "metrics.jsonl").read_bytes()
    assert (whole / "DONE").read_bytes() == (resumed / "DONE").read_bytes()
    other = train_relighting_model.run(pairs, pairs, Config(**{**vars(CONFIG), "seed": 6}), tmp_path / "other")
    assert any(not torch.equal(value, weights(other)[name]) for name, value in expected.items())
    scores = json.loads((whole / "validation" / "000006.json").read_text())["scores"]
    assert {"input", "mean_albedo", "anchor", "sample", "mean", "best", "bound"} <= set(scores)
    assert (whole / "validation" / "000006.png").exists()
    assert (whole / "DONE").exists()


def test_phases_by_step() -> None:
    assert [CONFIG.phase_at(step).size for step in (0, 1, 2, 5, 9)] == [16, 16, 32, 32, 32]
    assert CONFIG.num_steps == 6
    assert CONFIG.scale_momentum_at(2) == 1.0 and CONFIG.scale_momentum_at(5) == 0.0


def test_training_goes_on_from_given_weights(tmp_path: Path) -> None:
    pairs = write_items(tmp_path / "pairs")
    first = train_relighting_model.run(pairs, pairs, CONFIG, tmp_path / "first")
    still = Config(
        model=TINY,
        phases=(Phase(1, 16, "products"),),
        batch_size=1,
        peak_learning_rate=1e-12,
        initial_model=str(first),
        loss=LossWeights(anchor=0.0),
        device="cpu",
    )
    second = train_relighting_model.run(pairs, pairs, still, tmp_path / "second")
    expected = weights(first)
    assert all(torch.allclose(value, expected[name], atol=1e-6) for name, value in weights(second).items())


def curve(folder: Path) -> list[float]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line["loss"] for line in lines if line["kind"] == "train"]


def test_metrics_and_validations_on_the_way(tmp_path: Path) -> None:
    pairs = write_items(tmp_path / "pairs")
    out = train_relighting_model.run(pairs, pairs, CONFIG, tmp_path / "out")
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if line["kind"] == "train"] == [1, 2, 3, 4, 5, 6]
    assert [line["step"] for line in lines if line["kind"] == "validation"] == [4, 6]
    assert {"loss", "anchor", "diffusion", "learning_rate"} <= set(lines[-2])
    assert sorted(path.name for path in (out / "validation").iterdir()) == [
        "000004.json",
        "000004.png",
        "000006.json",
        "000006.png",
    ]
    assert read_metrics(out)["examples_per_second"] > 0


def test_threads_change_nothing_and_bfloat16_a_little(tmp_path: Path) -> None:
    pairs = write_items(tmp_path / "pairs")
    curves = {}
    for name, execution in {
        "plain": ExecutionConfig(),
        "threads": ExecutionConfig(num_threads=2),
        "bfloat16": ExecutionConfig(precision="bfloat16"),
    }.items():
        config = Config(**{**vars(CONFIG), "execution": execution})
        curves[name] = curve(train_relighting_model.run(pairs, pairs, config, tmp_path / name))
    assert curves["threads"] == curves["plain"] != curves["bfloat16"]
    assert curves["bfloat16"] == pytest.approx(curves["plain"], rel=0.05)


def test_parts_of_a_step_add_up(tmp_path: Path) -> None:
    pairs = write_items(tmp_path / "pairs")
    curves = []
    for parts, seed in ((1, 5), (2, 5), (4, 5), (1, 6)):
        # One latent scale per step needs the whole step at once, so the phases that measure it are left out.
        config = Config(
            **{
                **vars(CONFIG),
                "batch_size": 4,
                "accumulation": parts,
                "seed": seed,
                "phases": (Phase(4, 16, "products"),),
            }
        )
        curves.append(curve(train_relighting_model.run(pairs, pairs, config, tmp_path / f"{parts}{seed}")))
    assert curves[1] == pytest.approx(curves[0], rel=1e-3)  # least-squares gains pass rounding on, enlarged
    assert curves[2] == pytest.approx(curves[0], rel=1e-3)
    assert curves[3] != pytest.approx(curves[0], rel=1e-2)


def test_tensorboard_is_optional_and_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = write_items(tmp_path / "pairs")
    config = Config(**{**vars(CONFIG), "monitoring": MonitoringConfig(tensorboard=True)})
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.delitem(sys.modules, "torch.utils.tensorboard", raising=False)
    with pytest.raises(UserError, match=r"illuminerf\[training\]"):
        train_relighting_model.run(pairs, pairs, config, tmp_path / "out")


def test_tensorboard_logs(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    pairs = write_items(tmp_path / "pairs")
    monitoring = MonitoringConfig(log_steps=1, validation_steps=4, validation_pairs=2, final_pairs=2, tensorboard=True)
    config = Config(**{**vars(CONFIG), "monitoring": monitoring})
    out = train_relighting_model.run(pairs, pairs, config, tmp_path / "out")
    assert list((out / "tensorboard").glob("events*"))


def test_bad_settings_are_user_errors(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="at least one"):
        Config(batch_size=0)
    with pytest.raises(UserError, match="multiple of 3"):
        pairs = write_items(tmp_path / "pairs")
        train_relighting_model.run(pairs, pairs, Config(**{**vars(CONFIG), "accumulation": 3}), tmp_path / "uneven")
    with pytest.raises(UserError, match="train a part"):
        Config(control=ControlledBaseConfig(base="somewhere"))
    with pytest.raises(UserError, match="holds no training items"):
        train_relighting_model.run(tmp_path, tmp_path, CONFIG, tmp_path / "out")
