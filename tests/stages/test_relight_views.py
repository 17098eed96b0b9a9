"""Relit samples: resumable, seeded, at the capture's size, black off the object."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from illuminerf.data.capture import write_capture
from illuminerf.diffusion.augmentation import TRAINING_LEVEL
from illuminerf.diffusion.hub import repository_folder
from illuminerf.diffusion.pretrained import save_relighter
from illuminerf.diffusion.relighting_model import save_model
from illuminerf.presets import PRESETS
from illuminerf.scene.cameras import Cameras, look_at
from illuminerf.scene.images import read_exr, read_png, write_exr
from illuminerf.stages import relight_views
from illuminerf.stages.relight_views import Config, sample_path
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.config import to_json
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import tiny_model, with_noise_in_every_weight
from tests.diffusion.tiny_base import tiny_config, tiny_controlled, write_base, write_published

SIZE = 40  # not a multiple of the model's 32
CONFIG = Config(num_samples=2, num_steps=2, batch_size=2, device="cpu")
CUES = [f"{lobe}.{c}" for lobe in ("diffuse", "ggx_005", "ggx_013", "ggx_034") for c in "RGB"]


@pytest.fixture
def inputs(tmp_path: Path) -> tuple[Path, Path, Path]:
    """A capture of three discs, constant cues, and a model that is not trained."""
    generator = np.random.default_rng(0)
    axis = np.linspace(-1, 1, SIZE)
    alpha = (axis[:, None] ** 2 + (axis - 0.2) ** 2 < 0.4).astype(np.float32)
    images = [np.dstack([0.5 * generator.random((SIZE, SIZE, 3)), alpha]).astype(np.float32) for _ in range(3)]
    poses = np.stack([look_at(np.array([3.0, k, 1.0]), np.zeros(3)) for k in range(3)])
    intrinsics = np.tile([60.0, 60.0, SIZE / 2, SIZE / 2], (3, 1))
    cameras = Cameras(poses, intrinsics, SIZE, SIZE)
    capture, cues, model = tmp_path / "capture", tmp_path / "cues", tmp_path / "model"
    write_capture(capture, images, cameras, ["a", "b", "c"], 1.0, np.zeros(3), "masked")
    for view in range(3):
        write_exr(cues / "cues" / f"{view:03d}.exr", {name: 0.5 * alpha for name in CUES} | {"A": alpha})
    save_model(with_noise_in_every_weight(tiny_model()), model)
    return capture, cues, model


def samples(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "samples").glob("*.png"))}


def test_samples_are_complete_seeded_and_masked(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    out = relight_views.run(*inputs, None, CONFIG, tmp_path / "out")
    assert sorted(samples(out)) == [f"{view:03d}_{k:02d}.png" for view in range(3) for k in range(2)]
    first, second = (read_png(sample_path(out, 0, k)) for k in range(2))
    assert first.shape == (SIZE, SIZE, 3)
    alpha = read_png(inputs[0] / "images" / "000.png")[..., 3]
    assert (first[alpha == 0] == 0).all() and first[alpha == 1].max() > 0
    assert np.abs(first - second).max() > 0.02
    seeds = json.loads((out / "seeds.json").read_text())
    assert len({seed for row in seeds.values() for seed in row}) == 6
    again = relight_views.run(*inputs, None, CONFIG, tmp_path / "again")
    assert samples(again) == samples(out)


def test_one_exposure_for_all_views_from_the_diffuse_cue(inputs: tuple[Path, Path, Path]) -> None:
    _, cues, _ = inputs
    assert relight_views.exposure_for(3, cues) == pytest.approx(TRAINING_LEVEL / 0.5, rel=1e-3)
    for path in (cues / "cues").iterdir():
        channels = read_exr(path)
        write_exr(path, {name: 0.1 * image if name != "A" else image for name, image in channels.items()})
    assert relight_views.exposure_for(3, cues) == pytest.approx(TRAINING_LEVEL / 0.05, rel=1e-3)
    for path in (cues / "cues").iterdir():
        write_exr(path, {name: 0 * image if name != "A" else image for name, image in read_exr(path).items()})
    assert relight_views.exposure_for(3, cues) == 1


def test_specular_cues_are_dimmed_to_the_gloss_that_photographs_show(
    inputs: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    capture, cues, model = inputs

    def relit(cues: Path, gloss: float | None, name: str) -> dict[str, bytes]:
        folder = tmp_path / f"illumination_{name}"
        for view in range(3):
            alpha = read_png(capture / "images" / f"{view:03d}.png")[..., 3]
            write_exr(folder / "shading" / f"{view:03d}.exr", dict.fromkeys("RGB", 0.5 * alpha) | {"A": alpha})
        write_json(folder / "light.json", {"gloss": gloss})
        return samples(relight_views.run(capture, cues, model, folder, CONFIG, tmp_path / name))

    for path in (cues / "cues").iterdir():
        dimmed = {n: image * (0.25 if n.startswith("ggx") else 1) for n, image in read_exr(path).items()}
        write_exr(tmp_path / "dimmed" / "cues" / path.name, dimmed)
    assert relit(cues, 0.25, "quarter") == relit(tmp_path / "dimmed", 1.0, "full")
    unknown = relit(cues, None, "unknown")
    assert unknown == relit(cues, 1.0, "dielectric") != relit(cues, 0.25, "again")


def test_existing_samples_are_kept_and_missing_ones_made(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    out = relight_views.run(*inputs, None, CONFIG, tmp_path / "out")
    whole = samples(out)
    (out / "DONE").unlink()
    sample_path(out, 2, 1).unlink()
    kept = sample_path(out, 0, 0).stat().st_mtime_ns
    relight_views.run(*inputs, None, CONFIG, out)
    assert sample_path(out, 0, 0).stat().st_mtime_ns == kept
    # A batch of another make-up may round differently: one level of 256.
    remade = read_png(sample_path(out, 2, 1))
    (tmp_path / "old.png").write_bytes(whole["002_01.png"])
    assert np.abs(remade - read_png(tmp_path / "old.png")).max() <= 1.01 / 255


def test_detail_of_the_photograph_survives(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """The noise in the photographs is finer than the model's pixels; a plain enlargement would lose it."""
    torch.manual_seed(0)
    save_model(tiny_model(), tmp_path / "copying")  # starts as 0.2 + 0.6 * image
    model = tmp_path / "copying"
    out = relight_views.run(inputs[0], inputs[1], model, None, CONFIG, tmp_path / "out")
    photograph = read_png(inputs[0] / "images" / "000.png")
    inside = photograph[..., 3] == 1
    mean = np.mean([read_png(sample_path(out, 0, k)) for k in range(2)], 0)
    detail = photograph[..., :3] - _blurred(photograph[..., :3])
    ours = mean - _blurred(mean)
    same = np.corrcoef(detail[inside].ravel(), ours[inside].ravel())[0, 1]
    assert same > 0.5
    enlarged = _blurred(photograph[..., :3])
    assert np.corrcoef(detail[inside].ravel(), (enlarged - _blurred(enlarged))[inside].ravel())[0, 1] < same


def test_shares_make_what_one_process_makes(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    settings = Config(**{**vars(CONFIG), "batch_size": 1})
    whole = samples(relight_views.run(*inputs, None, settings, tmp_path / "whole"))
    out = tmp_path / "shared"
    for shard in ("1/2", "0/2"):
        assert not (out / "DONE").exists()
        relight_views.run(*inputs, None, Config(**{**vars(settings), "shard": shard}), out)
    assert samples(out) == whole
    assert (out / "DONE").exists()
    assert (out / "DONE").read_bytes() == (tmp_path / "whole" / "DONE").read_bytes()
    relight_views.run(*inputs, None, settings, out)  # finished, whoever asks
    with pytest.raises(UserError, match="0/4"):
        Config(shard="4/4")


def test_torchrun_shares_the_work(
    inputs: tuple[Path, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Config(**{**vars(CONFIG), "batch_size": 1})
    for rank in (0, 1):
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("WORLD_SIZE", "2")
        relight_views.run(*inputs, None, settings, tmp_path / "out")
        assert len(samples(tmp_path / "out")) == (4, 6)[rank]


def test_a_model_on_a_base_and_bfloat16(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    base = write_base(tmp_path / "base")
    model = with_noise_in_every_weight(tiny_controlled(base))  # type: ignore[arg-type]
    save_relighter(model, tmp_path / "controlled")
    runs = {}
    for precision in ("float32", "bfloat16"):
        config = Config(num_samples=2, num_steps=2, batch_size=2, samples_at_once=1, precision=precision, device="cpu")  # type: ignore[arg-type]
        out = relight_views.run(inputs[0], inputs[1], tmp_path / "controlled", None, config, tmp_path / precision)
        runs[precision] = np.stack([read_png(sample_path(out, view, k)) for view in range(3) for k in range(2)])
    difference = np.abs(runs["float32"] - runs["bfloat16"])
    assert difference.max() > 0 and difference.mean() < 0.02
    assert np.abs(runs["float32"][0] - runs["float32"][1]).mean() > difference.mean()


def test_the_photographs_own_light_is_a_hint(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    alpha = read_exr(inputs[1] / "cues" / "000.exr")["A"]
    for view in range(3):
        slope = np.linspace(0.1, 1.5, SIZE, dtype=np.float32) * alpha
        write_exr(tmp_path / "light" / "shading" / f"{view:03d}.exr", {"R": slope, "G": slope, "B": slope, "A": alpha})
    write_json(tmp_path / "light" / "light.json", {"gloss": None})
    plain = samples(relight_views.run(*inputs, None, CONFIG, tmp_path / "plain"))
    hinted = samples(relight_views.run(*inputs, tmp_path / "light", CONFIG, tmp_path / "hinted"))
    assert all(plain[name] != hinted[name] for name in plain)
    with pytest.raises(UserError, match="other"):
        relight_views.run(*inputs, tmp_path / "light", CONFIG, tmp_path / "plain")


def test_the_published_weights_relight_by_their_name(
    inputs: tuple[Path, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ILLUMINERF_MODELS", str(tmp_path / "models"))
    folder = repository_folder("dilightnet/DiLightNet")
    base = write_base(tmp_path / "base", prediction_type="v_prediction")
    write_published(folder, base)
    write_json(folder / "relighting_model.json", to_json(tiny_config(base, cue_coding="srgb8")))
    config = replace(PRESETS["dilightnet"].relighting, num_samples=2, num_steps=2, device="cpu")
    out = relight_views.run(inputs[0], inputs[1], "dilightnet", None, config, tmp_path / "out")
    images = [read_png(sample_path(out, 1, k)) for k in range(2)]
    alpha = read_png(inputs[0] / "images" / "001.png")[..., 3]
    assert images[0].shape == (SIZE, SIZE, 3) and (images[0][alpha == 0] == 0).all()
    assert np.abs(images[0] - images[1]).max() > 0.02


def _blurred(image: np.ndarray) -> np.ndarray:
    return sum(np.roll(image, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9


def test_what_does_not_fit_is_a_user_error(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    capture, cues, model = inputs
    with pytest.raises(UserError, match="holds no relighting model"):
        relight_views.run(capture, cues, tmp_path / "none", None, CONFIG, tmp_path / "out")
    write_exr(cues / "cues" / "001.exr", {name: np.zeros((8, 8), np.float32) for name in [*CUES, "A"]})
    with pytest.raises(UserError, match="does not fit the capture"):
        relight_views.run(capture, cues, model, None, CONFIG, tmp_path / "out")
    (cues / "cues" / "001.exr").unlink()
    with pytest.raises(UserError, match="missing"):
        relight_views.run(capture, cues, model, None, CONFIG, tmp_path / "out2")
    with pytest.raises(UserError, match="at least 1"):
        Config(num_samples=0)
