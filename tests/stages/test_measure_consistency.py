"""Agreement between views: samples of single views disagree, one 3D appearance does not."""

from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.capture import load_capture
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.scene.images import write_png
from illuminerf.stages import fit_latent_nerf, measure_consistency
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError

FIT = fit_latent_nerf.Config(optimiser=OptimiserConfig(num_steps=150, rays_per_step=256, warmup_steps=10), device="cpu")
CONFIG = measure_consistency.Config(num_pairs=6, tolerance=0.05, num_codes=3, num_code_views=1, device="cpu")


@pytest.fixture(scope="module")
def relit(sphere_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two samples per view; every one has a brightness of its own."""
    folder, generator = tmp_path_factory.mktemp("relit"), np.random.default_rng(0)
    for view, image in enumerate(load_capture(sphere_capture).views.premultiplied()):
        for sample in range(2):
            gain = generator.uniform(0.5, 1.2)
            write_png(folder / "samples" / f"{view:03d}_{sample:02d}.png", np.clip(gain * image, 0, 1))
    return folder


@pytest.fixture(scope="module")
def latent_nerf(
    sphere_geometry: Path, sphere_capture: Path, relit: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    return fit_latent_nerf.run(sphere_geometry, sphere_capture, relit, FIT, tmp_path_factory.mktemp("nerf") / "nerf")


def test_renderings_agree_better_than_samples(
    sphere_capture: Path, relit: Path, latent_nerf: Path, tmp_path: Path
) -> None:
    out = measure_consistency.run(sphere_capture, relit, latent_nerf, CONFIG, tmp_path / "out")
    measured = read_json(out / "consistency.json")
    print(measured)
    assert measured["matches"] > 200 and measured["pairs"] == 6
    assert measured["renderings"] < 0.5 * measured["samples"]
    assert measured["photographs"] < 0.5 * measured["samples"]  # the same texture from everywhere
    assert measured["codes_alpha"] == 0 < 0.01 < measured["codes_colour"]
    assert read_metrics(out)["samples"] == measured["samples"]


def test_samples_that_agree_are_measured_so(sphere_capture: Path, latent_nerf: Path, tmp_path: Path) -> None:
    """The photographs in the samples' place."""
    for view, image in enumerate(load_capture(sphere_capture).views.premultiplied()):
        write_png(tmp_path / "relit" / "samples" / f"{view:03d}_00.png", image)
    out = measure_consistency.run(sphere_capture, tmp_path / "relit", latent_nerf, CONFIG, tmp_path / "out")
    measured = read_json(out / "consistency.json")
    assert measured["samples"] == pytest.approx(measured["photographs"], abs=2e-3)


def test_a_view_without_samples_is_named(sphere_capture: Path, latent_nerf: Path, tmp_path: Path) -> None:
    (tmp_path / "relit").mkdir()
    with pytest.raises(UserError, match="no sample of view"):
        measure_consistency.run(sphere_capture, tmp_path / "relit", latent_nerf, CONFIG, tmp_path / "out")
