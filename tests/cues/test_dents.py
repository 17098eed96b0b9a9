"""Dented cue geometry: tilts are as large as asked for, nothing tears, and exact items stay exact."""

import numpy as np
import pytest
import trimesh

from illuminerf.cues.dents import DentVariation, dented, drawn_tilts
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.workflow.errors import UserError

BALL = sphere_mesh(3)
SIZES = (0.15, 0.05)


def tilt_of(mesh: TriangleMesh) -> float:
    """RMS angle in degrees between the normals and those of the undented ball, along one tangent."""
    radial = mesh.vertices / np.linalg.norm(mesh.vertices, axis=-1, keepdims=True)
    cosine = (radial * mesh.vertex_normals).sum(-1).clip(-1, 1)
    return float(np.degrees(np.sqrt((np.arccos(cosine) ** 2).mean() / 2)))


@pytest.mark.parametrize("tilts", [(6.0, 0.0), (0.0, 6.0)])
def test_normals_tilt_by_the_angle_asked_for(tilts: tuple[float, float]) -> None:
    found = [tilt_of(dented(BALL, SIZES, tilts, np.random.default_rng(seed))) for seed in range(6)]
    assert np.mean(found) == pytest.approx(6.0, rel=0.2)
    assert tilt_of(dented(BALL, SIZES, (0.0, 0.0), np.random.default_rng(0))) < 0.1


def test_normals_are_those_of_the_displaced_surface() -> None:
    mesh = dented(BALL, SIZES, (5.0, 5.0), np.random.default_rng(1))
    own = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
    undented = mesh.vertices / np.linalg.norm(mesh.vertices, axis=-1, keepdims=True)
    agreement = float((own * mesh.vertex_normals).sum(-1).mean())
    assert agreement > 0.998
    assert float((own * undented).sum(-1).mean()) < 0.992


def test_vertices_in_one_place_stay_in_one_place() -> None:
    box = trimesh.creation.box((1, 1, 1))
    box.unmerge_vertices()
    mesh = TriangleMesh(
        np.asarray(box.vertices, np.float32),
        np.asarray(box.faces, np.int32),
        np.asarray(box.vertex_normals, np.float32),
    )
    result = dented(mesh, SIZES, (8.0, 8.0), np.random.default_rng(2))
    merged = trimesh.Trimesh(result.vertices, result.faces, process=False)
    merged.merge_vertices(merge_norm=True, merge_tex=True)
    # split edges leave T-junctions within a face, but the box stays as closed as its volume says
    assert abs(merged.volume) == pytest.approx(1.0, rel=0.1)
    assert len(result.faces) > 12 and np.isfinite(result.vertices).all()


def test_share_of_dented_items() -> None:
    drawn = [drawn_tilts(DentVariation(0.4), np.random.default_rng(seed)) for seed in range(200)]
    assert 50 < sum(bool(tilts) for tilts in drawn) < 110
    assert all(0 <= tilt <= 9 for tilts in drawn for tilt in tilts)
    assert not any(drawn_tilts(DentVariation(0.0), np.random.default_rng(seed)) for seed in range(20))


@pytest.mark.parametrize("arguments", [(1.5,), (0.5, 60.0), (0.5, 5.0, ()), (0.5, 5.0, (0.0,))])
def test_bad_settings_are_refused(arguments: tuple) -> None:  # type: ignore[type-arg]
    with pytest.raises(UserError):
        DentVariation(*arguments)
