"""Latent NeRF on samples that disagree: codes explain the disagreement, the zero code is in its midst."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.capture import load_capture
from illuminerf.fields import optimisation
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.scene.images import read_png, write_png
from illuminerf.stages import fit_latent_nerf, render_novel_views
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.errors import UserError

CONFIG = fit_latent_nerf.Config(
    optimiser=OptimiserConfig(num_steps=250, rays_per_step=256, warmup_steps=10, checkpoint_every=100),
    device="cpu",
)
_GAINS = (0.6, 1.0, 1.4)


@pytest.fixture(scope="module")
def geometry(sphere_geometry: Path) -> Path:
    return sphere_geometry


@pytest.fixture(scope="module")
def relit(sphere_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three samples per view that differ in brightness."""
    folder = tmp_path_factory.mktemp("relit")
    for view, image in enumerate(load_capture(sphere_capture).views.premultiplied()):
        for sample, gain in enumerate(_GAINS):
            write_png(folder / "samples" / f"{view:03d}_{sample:02d}.png", np.clip(0.6 * gain * image, 0, 1))
    return folder


@pytest.fixture(scope="module")
def latent_nerf(geometry: Path, sphere_capture: Path, relit: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("latent") / "nerf"
    return fit_latent_nerf.run(geometry, sphere_capture, relit, CONFIG, out)


def test_codes_explain_what_one_appearance_cannot(
    geometry: Path, sphere_capture: Path, relit: Path, latent_nerf: Path, tmp_path: Path
) -> None:
    plain = replace(CONFIG, use_latents=False)
    without = fit_latent_nerf.run(geometry, sphere_capture, relit, plain, tmp_path / "plain")
    assert read_metrics(latent_nerf)["train_psnr"] > read_metrics(without)["train_psnr"] + 3


def test_shuffled_codes_explain_nothing(
    geometry: Path, sphere_capture: Path, relit: Path, latent_nerf: Path, tmp_path: Path
) -> None:
    shuffled = replace(CONFIG, shuffles_latents=True)
    out = fit_latent_nerf.run(geometry, sphere_capture, relit, shuffled, tmp_path / "shuffled")
    assert read_metrics(out)["train_psnr"] < read_metrics(latent_nerf)["train_psnr"] - 3
    with pytest.raises(UserError, match="no codes to shuffle"):
        replace(shuffled, use_latents=False)


def _brightness(field: Path, sphere_capture: Path, latent_index: int | None, out: Path) -> float:
    config = render_novel_views.Config(latent_index=latent_index, device="cpu")
    render_novel_views.run(field, sphere_capture, config, out)
    image = read_png(out / "images" / "000.png")
    return float(image[image[..., 3] > 0.9, :3].mean())


def test_zero_code_lies_between_the_samples(
    latent_nerf: Path, sphere_capture: Path, relit: Path, tmp_path: Path
) -> None:
    dark, middle, bright = (
        _brightness(latent_nerf, sphere_capture, index, tmp_path / str(index)) for index in (0, None, 2)
    )
    assert dark + 0.05 < middle < bright - 0.05
    sample = read_png(relit / "samples" / "000_00.png")
    assert abs(dark - sample[sample.max(-1) > 0].mean()) < 0.05


@pytest.mark.parametrize(("share", "is_mean"), [(CONFIG.zero_code_share, True), (0.0, False)])
def test_the_zero_code_is_the_mean_of_the_samples(
    geometry: Path, sphere_capture: Path, share: float, is_mean: bool, tmp_path: Path
) -> None:
    greys = (0.1, 0.2, 0.9)  # uneven: the code between them need not render their mean
    for path in sorted((sphere_capture / "images").glob("*.png")):
        for sample, grey in enumerate(greys):
            even = np.repeat(grey * read_png(path)[..., 3:], 3, -1)
            write_png(tmp_path / "relit" / "samples" / f"{path.stem}_{sample:02d}.png", even)
    config = replace(CONFIG, zero_code_share=share)
    fitted = fit_latent_nerf.run(geometry, sphere_capture, tmp_path / "relit", config, tmp_path / "nerf")
    brightness = _brightness(fitted, sphere_capture, None, tmp_path / "views")
    assert (abs(brightness - np.mean(greys)) < 0.02) == is_mean


def test_colours_do_not_darken_where_mask_and_surface_disagree(
    geometry: Path, sphere_capture: Path, relit: Path, tmp_path: Path
) -> None:
    shutil.copytree(sphere_capture, tmp_path / "soft")
    for path in sorted((tmp_path / "soft" / "images").glob("*.png")):
        image = read_png(path)
        image[..., 3] *= 0.6
        write_png(path, image)
        for sample in range(3):  # the very colour 0.5 everywhere, over black
            even = np.repeat(0.5 * image[..., 3:], 3, -1)
            write_png(tmp_path / "relit" / "samples" / f"{path.stem}_{sample:02d}.png", even)
    fitted = fit_latent_nerf.run(geometry, tmp_path / "soft", tmp_path / "relit", CONFIG, tmp_path / "nerf")
    brightness = _brightness(fitted, sphere_capture, None, tmp_path / "views")
    assert abs(brightness - 0.5) < 0.04  # 0.3 if the mask's coverage were taken for the surface's


def test_geometry_is_untouched(geometry: Path, latent_nerf: Path) -> None:
    from illuminerf.fields.storage import load_field

    before, after = load_field(geometry), load_field(latent_nerf)
    for name, value in before.field.surface.state_dict().items():
        assert bool((value == after.field.surface.state_dict()[name]).all()), name
    old, new = before.field.appearance.grid.table, after.field.appearance.grid.table
    assert not bool((old == new).all())
    assert after.latents is not None and after.latents.shape == (36, 4)


def test_a_killed_fit_goes_on_to_the_same_bytes(
    geometry: Path,
    sphere_capture: Path,
    relit: Path,
    latent_nerf: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learning_rate = OptimiserConfig.learning_rate

    def dies(self: OptimiserConfig, step: int) -> float:
        if step == 130:
            raise KeyboardInterrupt
        return learning_rate(self, step)

    monkeypatch.setattr(optimisation.OptimiserConfig, "learning_rate", dies)
    out = tmp_path / "nerf"
    with pytest.raises(KeyboardInterrupt):
        fit_latent_nerf.run(geometry, sphere_capture, relit, CONFIG, out)
    assert (out / "checkpoint.safetensors").exists()
    monkeypatch.undo()
    fit_latent_nerf.run(geometry, sphere_capture, relit, CONFIG, out)
    assert (out / "DONE").read_text() == (latent_nerf / "DONE").read_text()


def test_missing_and_misfit_samples_are_named(
    geometry: Path, sphere_capture: Path, relit: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="no relit samples"):
        fit_latent_nerf.run(geometry, sphere_capture, tmp_path, CONFIG, tmp_path / "none" / "out")
    partial = tmp_path / "partial"
    shutil.copytree(relit, partial)
    (partial / "samples" / "003_01.png").unlink()
    with pytest.raises(UserError, match="view 3"):
        fit_latent_nerf.find_samples(partial, 12)
    with pytest.raises(UserError, match="not made from this capture"):
        fit_latent_nerf.find_samples(relit, 5)
    small = tmp_path / "small"
    shutil.copytree(relit, small)
    write_png(small / "samples" / "000_00.png", np.zeros((8, 8, 3), np.float32))
    with pytest.raises(UserError, match="another size"):
        fit_latent_nerf.run(geometry, sphere_capture, small, CONFIG, tmp_path / "out")
