"""A tiny fit of an analytic sphere: its mesh is that sphere, and an interrupted fit ends in the same bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from illuminerf.data.capture import load_capture, save_capture
from illuminerf.fields import optimisation
from illuminerf.fields.geometry_fit import GeometryLossConfig
from illuminerf.fields.image_rendering import observed_cells
from illuminerf.fields.meshing import EmptySurface
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.fields.storage import load_field
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.views import Views
from illuminerf.stages import estimate_geometry
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.config import from_json, to_json
from illuminerf.workflow.errors import UserError
from tests.stages.conftest import TINY_GEOMETRY

CONFIG = replace(
    TINY_GEOMETRY,
    optimiser=OptimiserConfig(num_steps=200, rays_per_step=128, warmup_steps=10, checkpoint_every=60),
    losses=GeometryLossConfig(first_levels=2),
    mesh_resolution=48,
    num_held_out_views=1,
    num_previews=1,
)


@pytest.fixture(scope="module")
def geometry(sphere_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return estimate_geometry.run(sphere_capture, CONFIG, tmp_path_factory.mktemp("fit") / "geometry")


def test_mesh_is_the_sphere(geometry: Path) -> None:
    mesh = TriangleMesh.load_glb(geometry / "mesh.glb")
    radius = np.linalg.norm(mesh.vertices, axis=-1)
    assert abs(np.median(radius) - 0.6) < 0.02
    assert np.quantile(np.abs(radius - 0.6), 0.95) < 0.05
    outward = mesh.vertices / radius[:, None]
    assert np.median((mesh.vertex_normals * outward).sum(-1)) > 0.95
    corners = mesh.vertices[mesh.faces]
    winding = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.mean((winding * corners.mean(1)).sum(-1) > 0) > 0.99


def test_held_out_view_is_reproduced(geometry: Path) -> None:
    assert read_metrics(geometry)["held_out_psnr"] > 19


def test_files(geometry: Path) -> None:
    names = {path.name for path in geometry.iterdir()}
    assert {"field.safetensors", "field.json", "mesh.glb", "normals", "DONE"} <= names
    assert "checkpoint.safetensors" not in names
    assert (geometry / "normals" / "000.png").is_file()


@pytest.mark.parametrize("killed_at", [30, 61])
def test_a_killed_fit_goes_on_to_the_same_bytes(
    geometry: Path, sphere_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed_at: int
) -> None:
    out, learning_rate = tmp_path / "geometry", OptimiserConfig.learning_rate

    def dies(self: OptimiserConfig, step: int) -> float:
        if step == killed_at:
            raise KeyboardInterrupt
        return learning_rate(self, step)

    monkeypatch.setattr(optimisation.OptimiserConfig, "learning_rate", dies)
    with pytest.raises(KeyboardInterrupt):
        estimate_geometry.run(sphere_capture, CONFIG, out)
    assert not (out / "DONE").exists()
    assert (out / "checkpoint.safetensors").exists() == (killed_at > 60)
    monkeypatch.undo()
    estimate_geometry.run(sphere_capture, CONFIG, out)
    for name in ("field.safetensors", "mesh.glb", "normals/000.png"):
        assert (out / name).read_bytes() == (geometry / name).read_bytes(), name
    assert (out / "DONE").read_text() == (geometry / "DONE").read_text()


def test_another_seed_is_another_field(geometry: Path, sphere_capture: Path, tmp_path: Path) -> None:
    """The guard of the byte comparison."""
    few = replace(CONFIG.optimiser, num_steps=3)
    fields = []
    for seed in (0, 1):
        config = replace(CONFIG, seed=seed, optimiser=few)
        out = estimate_geometry.run(sphere_capture, config, tmp_path / str(seed))
        fields.append((out / "field.safetensors").read_bytes())
    assert fields[0] != fields[1]


def test_a_random_background_shows_the_outline_of_a_black_object(sphere_capture: Path, tmp_path: Path) -> None:
    """Over black its colours say nothing of where it ends; here there is no mask loss to say it either."""
    capture = load_capture(sphere_capture)
    views = capture.views
    alpha = np.stack(list(views.alphas()))
    black = Views(views.cameras, np.zeros((*alpha.shape, 3), np.float32), alpha)
    save_capture(tmp_path / "black", replace(capture, views=black))
    surface = replace(CONFIG.radiance_field.surface, initial_radius=0.4)
    losses = replace(CONFIG.losses, mask=0.0, starts_from_hull=False)
    config = replace(CONFIG, losses=losses, radiance_field=replace(CONFIG.radiance_field, surface=surface))
    out = estimate_geometry.run(tmp_path / "black", config, tmp_path / "out")
    radius = np.linalg.norm(TriangleMesh.load_glb(out / "mesh.glb").vertices, axis=-1)
    assert abs(float(np.median(radius)) - 0.6) < 0.05
    over_black = replace(config, losses=replace(losses, random_background=False))
    with pytest.raises(EmptySurface, match="is empty"):
        estimate_geometry.run(tmp_path / "black", over_black, tmp_path / "over_black")


def test_stored_field_has_tight_cells(geometry: Path) -> None:
    stored = load_field(geometry)
    assert bool(stored.cells.contains(torch.tensor([[0.58, 0, 0], [0.0, -0.58, 0]])).all())
    assert not bool(stored.cells.contains(torch.tensor([[0.9, 0, 0], [0.0, 0.0, 0.95]])).any())


def test_what_no_photograph_shows_is_not_kept(geometry: Path, sphere_capture: Path) -> None:
    """Seen from one side only, the far side of the ball is unobserved; from all sides the cells stay."""
    stored = load_field(geometry)
    cameras = load_capture(sphere_capture).views.cameras
    everywhere = observed_cells(stored.field, stored.cells, cameras)
    one_side = observed_cells(stored.field, stored.cells, cameras[0])
    towards = torch.from_numpy(cameras.positions[0]).float()
    towards = towards / towards.norm()
    side = stored.cells.cells.shape[0]
    depth = ((one_side.cells.nonzero() + 0.5) * 2 / side - 1) @ towards
    assert everywhere.cells.sum() > 0.8 * stored.cells.cells.sum()
    assert one_side.cells.sum() < 0.75 * everywhere.cells.sum()
    assert (depth > 0).float().mean() > 0.7


def test_configs_survive_json_and_refuse_nonsense() -> None:
    for config in (CONFIG, estimate_geometry.Config(), estimate_geometry.Config.paper()):
        assert from_json(estimate_geometry.Config, to_json(config)) == config
    with pytest.raises(UserError):
        replace(CONFIG, mesh_resolution=1)
    with pytest.raises(UserError):
        OptimiserConfig(num_steps=0)


def test_learning_rate_warms_up_and_decays() -> None:
    paper = OptimiserConfig.paper()
    assert paper.learning_rate(0) < 1e-5
    assert paper.learning_rate(500) == pytest.approx(5e-3, rel=0.05)
    assert paper.learning_rate(24_999) == pytest.approx(5e-4)
    assert paper.learning_rate(12_500) == pytest.approx((5e-3 * 5e-4) ** 0.5, rel=1e-3)


def test_a_corrupt_field_is_explained(geometry: Path, tmp_path: Path) -> None:
    (tmp_path / "field.json").write_bytes((geometry / "field.json").read_bytes())
    (tmp_path / "field.safetensors").write_bytes((geometry / "field.safetensors").read_bytes()[:1000])
    with pytest.raises(UserError):
        load_field(tmp_path)
