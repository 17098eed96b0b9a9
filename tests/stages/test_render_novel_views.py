"""Novel views: files, colour coding, cameras, resume."""

from pathlib import Path

import numpy as np
import pytest
import torch

from illuminerf.fields.appearance import AppearanceConfig
from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.proposal_sampling import ProposalConfig
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.storage import StoredField, save_field
from illuminerf.fields.surface import SurfaceConfig
from illuminerf.scene.cameras import Cameras, turntable_cameras
from illuminerf.scene.images import linear_from_srgb, read_exr, read_png
from illuminerf.stages import render_novel_views
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError

_GRID = HashGridConfig(2, 2, 8, 4, 8)
_TURNTABLE = render_novel_views.TurntableConfig(num_views=3, radius=2.5, height=24, width=32)
_CONFIG = render_novel_views.Config(turntable=_TURNTABLE, rays_per_chunk=100, device="cpu")


@pytest.fixture(scope="module")
def sphere_field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained field is an opaque sphere of radius 0.5."""
    torch.manual_seed(0)
    config = FieldConfig(
        SurfaceConfig(_GRID, 8, _GRID, 8, initial_beta=3e-4),
        AppearanceConfig(_GRID, 8, 8, 1, 1, 4, 8),
        ProposalConfig(_GRID, 8),
        num_proposal_samples=32,
        num_samples=24,
    )
    folder = tmp_path_factory.mktemp("field")
    cells = OccupiedCells(torch.ones(16, 16, 16, dtype=torch.bool))
    field = RadianceField(config)
    with torch.no_grad():
        field.surface.head.weight.zero_()
    save_field(folder, StoredField(field, cells, torch.randn(4, 4)))
    return folder


def test_turntable(sphere_field: Path, tmp_path: Path) -> None:
    out = render_novel_views.run(sphere_field, None, _CONFIG, tmp_path / "views")
    cameras = Cameras.from_dict(read_json(out / "cameras.json"))
    wanted = turntable_cameras(3, 2.5, _TURNTABLE.fov_radians, 24, 32, _TURNTABLE.elevation_radians)
    np.testing.assert_allclose(cameras.world_from_camera, wanted.world_from_camera)
    for view in range(3):
        image, linear = read_png(out / f"images/{view:03d}.png"), read_exr(out / f"linear/{view:03d}.exr")
        assert image.shape == (24, 32, 4)
        alpha = linear["A"]
        # a sphere of radius 0.5 at distance 2.5 covers pi f^2 r^2 / (d^2 - r^2) pixels (on the axis), its shell more
        focal = wanted.intrinsics[0, 0]
        assert alpha.sum() == pytest.approx(np.pi * focal**2 * 0.25 / (2.5**2 - 0.25), rel=0.06)
        np.testing.assert_allclose(image[..., 3], alpha, atol=4e-3)
        premultiplied = linear_from_srgb(image[..., :3]) * image[..., 3:]
        stacked = np.stack([linear[name] for name in "RGB"], -1)
        np.testing.assert_allclose(stacked, premultiplied, atol=0.012)
        assert stacked.max() > 0.05


def test_chunks_do_not_change_the_image(sphere_field: Path, tmp_path: Path) -> None:
    first = render_novel_views.run(sphere_field, None, _CONFIG, tmp_path / "a")
    whole = render_novel_views.Config(turntable=_TURNTABLE, rays_per_chunk=10_000, device="cpu")
    second = render_novel_views.run(sphere_field, None, whole, tmp_path / "b")
    for view in range(3):
        names = f"images/{view:03d}.png"
        np.testing.assert_allclose(read_png(first / names), read_png(second / names), atol=5e-3)


def test_a_latent_code_changes_colours_and_not_shape(sphere_field: Path, tmp_path: Path) -> None:
    zero = render_novel_views.run(sphere_field, None, _CONFIG, tmp_path / "zero")
    coded = render_novel_views.Config(turntable=_TURNTABLE, latent_index=2, device="cpu")
    other = render_novel_views.run(sphere_field, None, coded, tmp_path / "other")
    a, b = read_exr(zero / "linear/000.exr"), read_exr(other / "linear/000.exr")
    np.testing.assert_allclose(a["A"], b["A"], atol=2e-3)
    assert np.abs(a["R"] - b["R"]).max() > 1e-3


def test_cameras_from_a_file_and_resume(sphere_field: Path, tmp_path: Path) -> None:
    write_json(tmp_path / "cameras.json", turntable_cameras(2, 3.0, 0.5, 12, 12).to_dict())
    out = tmp_path / "views"
    render_novel_views.run(sphere_field, tmp_path / "cameras.json", _CONFIG, out)
    done = (out / "DONE").read_text()
    (out / "DONE").unlink()
    (out / "linear" / "001.exr").unlink()
    kept = (out / "images" / "000.png").stat().st_mtime_ns
    render_novel_views.run(sphere_field, tmp_path / "cameras.json", _CONFIG, out)
    assert (out / "DONE").read_text() == done
    assert (out / "images" / "000.png").stat().st_mtime_ns == kept


def test_a_march_comes_closer_to_many_samples_than_few_do(sphere_geometry: Path, tmp_path: Path) -> None:
    configs = {"marched": (None, True), "few": (10, False), "many": (160, False)}
    images = {}
    for name, (num_samples, marches) in configs.items():
        config = render_novel_views.Config(turntable=_TURNTABLE, num_samples=num_samples, marches=marches, device="cpu")
        out = render_novel_views.run(sphere_geometry, None, config, tmp_path / name)
        pixels = np.stack([read_png(out / "images" / f"{view:03d}.png") for view in range(3)])
        images[name] = pixels[..., :3] * pixels[..., 3:]
    errors = {name: np.abs(images[name] - images["many"]).mean() for name in ("marched", "few")}
    assert errors["marched"] < 0.5 * errors["few"] and errors["few"] > 0, errors


def test_errors(sphere_field: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="march"):
        render_novel_views.Config(num_samples=4, marches=True)
    with pytest.raises(UserError, match="latent code 9"):
        wrong = render_novel_views.Config(turntable=_TURNTABLE, latent_index=9, device="cpu")
        render_novel_views.run(sphere_field, None, wrong, tmp_path / "a")
    with pytest.raises(UserError):
        render_novel_views.run(sphere_field, tmp_path / "nothing.json", _CONFIG, tmp_path / "b")
