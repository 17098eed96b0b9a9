"""Training: interrupted and resumed equals uninterrupted; the artefact is a loadable model."""

import json
from pathlib import Path

import pytest
import torch

from illuminerf.diffusion.objective import LossWeights
from illuminerf.diffusion.relighting_model import load_model
from illuminerf.stages import train_relighting_model
from illuminerf.stages.train_relighting_model import Config, Phase
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import TINY, write_items

CONFIG = Config(
    model=TINY,
    phases=(Phase(2, 16, "products"), Phase(1, 32, "diffusion"), Phase(3, 32)),
    batch_size=2,
    accumulation=2,
    warm_up_steps=2,
    checkpoint_seconds=0.0,
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

    def stops_at_three(training: train_relighting_model._Training) -> dict[str, float]:
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


def test_bad_settings_are_user_errors(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="at least one"):
        Config(batch_size=0)
    with pytest.raises(UserError, match="holds no training items"):
        train_relighting_model.run(tmp_path, tmp_path, CONFIG, tmp_path / "out")
