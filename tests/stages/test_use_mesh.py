"""A mesh in place of an estimate: its field is the mesh, later stages run on it, wrong meshes are refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from illuminerf.data.capture import load_capture, write_capture
from illuminerf.fields.image_rendering import render_image
from illuminerf.fields.mesh_fit import SurfaceRegressionConfig
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.fields.shell import surface_shell
from illuminerf.fields.storage import load_field
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.stages import render_novel_views, use_mesh
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.errors import UserError
from tests.stages.conftest import RADIUS, TINY_GEOMETRY, sphere_cameras_of, sphere_image

CONFIG = use_mesh.Config(
    radiance_field=TINY_GEOMETRY.radiance_field,
    regression=SurfaceRegressionConfig(num_steps=120, points_per_step=1024),
    optimiser=OptimiserConfig(num_steps=60, rays_per_step=128, warmup_steps=5),
    spacing=0.04,
    ray_size=48,
    occupancy_side=24,
    num_previews=1,
    device="cpu",
)
SCALE, OFFSET = 0.5, np.array([0.3, -0.2, 0.1])


def world_mesh(mesh: TriangleMesh) -> TriangleMesh:
    """From the unit ball into the caller's world."""
    return TriangleMesh((mesh.vertices / SCALE - OFFSET).astype(np.float32), mesh.faces, mesh.vertex_normals)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sphere's capture, of a caller's world that is twice as large and elsewhere."""
    folder, cameras = tmp_path_factory.mktemp("capture") / "capture", sphere_cameras_of(8)
    images = [sphere_image(cameras, view) for view in range(8)]
    write_capture(folder, images, cameras, [f"{view}" for view in range(8)], SCALE, OFFSET, "masked")
    return folder


@pytest.fixture(scope="module")
def geometry(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mesh")
    world_mesh(sphere_mesh(3, RADIUS)).save_glb(folder / "ball.glb")
    return use_mesh.run(folder / "ball.glb", capture, CONFIG, folder / "geometry")


def test_the_artefact_is_that_of_an_estimated_geometry(geometry: Path, sphere_geometry: Path) -> None:
    estimated = {path.name for path in sphere_geometry.iterdir()}
    assert estimated - {path.name for path in geometry.iterdir()} == set()
    assert (geometry / "normals" / "000.png").is_file() and not (geometry / "checkpoint.safetensors").exists()
    mesh = TriangleMesh.load_glb(geometry / "mesh.glb")
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=-1), RADIUS, atol=1e-4)
    metrics = read_metrics(geometry)
    assert metrics["num_faces"] == len(mesh.faces) and metrics["mask_overlap"] > 0.95


def test_the_field_is_the_mesh_and_shows_the_photographs(geometry: Path, capture: Path) -> None:
    stored, views = load_field(geometry), load_capture(capture).views
    image = render_image(stored.field, surface_shell(stored.field.surface, stored.cells), views.cameras, 3)
    both = (image.alpha > 0.5) & (views.alpha[3] > 0.5)
    assert both.sum() / ((image.alpha > 0.5) | (views.alpha[3] > 0.5)).sum() > 0.85
    origins, directions = (rays.numpy() for rays in views.cameras.image_rays(3))
    places = origins + (image.depth / np.maximum(image.alpha, 1e-3))[..., None] * directions
    assert np.median(np.abs(np.linalg.norm(places, axis=-1) - RADIUS)[both]) < 0.02
    outward = places / np.linalg.norm(places, axis=-1, keepdims=True)
    assert np.median((image.normals * outward).sum(-1)[both]) > 0.9
    untaught = np.abs(0.5 - views.srgb[3])[both].mean()
    assert np.abs(image.srgb - views.srgb[3])[both].mean() < 0.6 * untaught


def test_the_same_mesh_gives_the_same_bytes(geometry: Path, capture: Path, tmp_path: Path) -> None:
    again = use_mesh.run(geometry.parent / "ball.glb", capture, CONFIG, tmp_path / "again")
    assert (again / "DONE").read_text() == (geometry / "DONE").read_text()


def test_later_stages_do_not_know_the_difference(geometry: Path, capture: Path, tmp_path: Path) -> None:
    write_json(tmp_path / "cameras.json", load_capture(capture).views.cameras[[0]].to_dict())
    config = render_novel_views.Config(device="cpu")
    out = render_novel_views.run(geometry, tmp_path / "cameras.json", config, tmp_path / "views")
    assert (out / "images" / "000.png").is_file()


def test_a_box_of_loose_faces_wound_either_way_becomes_solid(tmp_path: Path) -> None:
    """Six separate squares, every second one inside out, without a bottom: as a field it has an inside."""
    box = trimesh.creation.box(extents=(0.9, 0.9, 0.9))
    corners = np.asarray(box.triangles, np.float32).copy()
    corners[::2] = corners[::2, ::-1]
    corners = corners[np.asarray(box.face_normals)[:, 2] > -0.5]
    faces = np.arange(len(corners) * 3, dtype=np.int32).reshape(-1, 3)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.repeat(flat / np.linalg.norm(flat, axis=-1, keepdims=True), 3, 0).astype(np.float32)
    mesh = TriangleMesh(corners.reshape(-1, 3), faces, flat)
    cameras = use_mesh_cameras()
    target, normals = use_mesh._seen_from(mesh, cameras, CONFIG)
    points = np.array([[0, 0, 0], [0, 0, 0.4], [0.4, 0.4, 0.4], [0, 0, 0.5], [0.55, 0, 0], [0, 0, -0.6]], np.float64)
    found = target(points)
    assert (np.sign(found) == [-1, -1, -1, 1, 1, 1]).all()
    assert found[3] == pytest.approx(0.05, abs=0.01) and found[4] == pytest.approx(0.1, abs=0.01)
    assert (normals * target.seen.positions).sum(-1).min() > 0  # outward, however the faces were wound


def use_mesh_cameras():  # type: ignore[no-untyped-def]
    """From above only, all around."""
    from illuminerf.scene.cameras import spiral_cameras

    return spiral_cameras(12, 3.0, 0.75, 48, 48, 0.1, 1.5)


@pytest.mark.parametrize(("kind", "up_axis"), [("obj", "auto"), ("ply", "auto"), ("obj", "y")])
def test_other_files_are_read_as_they_stand(tmp_path: Path, kind: str, up_axis: use_mesh.UpAxis) -> None:
    tall = trimesh.creation.box(extents=(0.2, 0.4, 0.9))
    tall.export(tmp_path / f"box.{kind}")
    size = np.ptp(TriangleMesh.load(tmp_path / f"box.{kind}", up_axis).vertices, axis=0)
    np.testing.assert_allclose(size, [0.2, 0.4, 0.9] if up_axis == "auto" else [0.2, 0.9, 0.4], atol=1e-6)


def test_wrong_meshes_are_refused(capture: Path, tmp_path: Path) -> None:
    ball = sphere_mesh(2, RADIUS)
    aside = TriangleMesh((ball.vertices * 0.5 + [0.6, 0, 0]).astype(np.float32), ball.faces, ball.vertex_normals)
    world_mesh(aside).save_glb(tmp_path / "aside.glb")
    with pytest.raises(UserError, match="does not lie where"):
        use_mesh.run(tmp_path / "aside.glb", capture, CONFIG, tmp_path / "out")
    world_mesh(sphere_mesh(2, 1.2)).save_glb(tmp_path / "large.glb")
    with pytest.raises(UserError, match="beyond the object's place"):
        use_mesh.run(tmp_path / "large.glb", capture, CONFIG, tmp_path / "out_2")
    with pytest.raises(UserError, match="not a mesh file"):
        TriangleMesh.load(tmp_path / "ball.stl")
    with pytest.raises(UserError):
        replace(CONFIG, spacing=0.0)
