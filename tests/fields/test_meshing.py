"""The mesh's smooth normals: the surface's own, averaged over neighbours."""

import numpy as np
import pytest
import torch
import trimesh

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.meshing import averaged_normals, extract_mesh
from illuminerf.fields.surface import SurfaceConfig, SurfaceField

_GRID = HashGridConfig(num_levels=2, num_features=2, log2_entries=12, coarsest=8, finest=150)


def degrees_off(normals: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    cosine = (normals * wanted).sum(-1) / np.linalg.norm(normals, axis=-1) / np.linalg.norm(wanted, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@pytest.fixture(scope="module")
def bumpy_sphere() -> SurfaceField:
    torch.manual_seed(0)
    surface = SurfaceField(SurfaceConfig(grid=_GRID, normal_grid=_GRID))
    with torch.no_grad():
        surface.grid.table.normal_(std=0.02)
        surface.normal_grid.table.normal_(std=3.0)
    return surface


def test_normals_of_a_bumpy_sphere(bumpy_sphere: SurfaceField) -> None:
    cells = OccupiedCells(torch.ones(16, 16, 16, dtype=torch.bool))
    meshes = {name: extract_mesh(bumpy_sphere, cells, 96, normals=name) for name in ("averaged", "predicted")}
    vertices = torch.from_numpy(meshes["averaged"].vertices)
    own = bumpy_sphere(vertices).gradient.detach().numpy()
    # the surface's bumps are gone, and so is what predicted normals make up
    errors = degrees_off(meshes["averaged"].vertex_normals, meshes["averaged"].vertices)
    assert errors.mean() < 0.75 * degrees_off(own, meshes["averaged"].vertices).mean()
    np.testing.assert_allclose(np.linalg.norm(meshes["averaged"].vertex_normals, axis=-1), 1, atol=1e-5)
    predicted = bumpy_sphere.predicted_normals(vertices).detach().numpy()
    np.testing.assert_allclose(meshes["predicted"].vertex_normals, predicted, atol=1e-6)
    assert degrees_off(predicted, meshes["averaged"].vertices).mean() > 3 * errors.mean(), "the guard"


def test_averaging_takes_noise_and_leaves_what_is_smooth() -> None:
    sphere = trimesh.creation.icosphere(4)
    true, faces = sphere.vertices.astype(np.float32), sphere.faces.astype(np.int32)
    noisy = true + 0.3 * np.random.default_rng(0).normal(size=true.shape).astype(np.float32)
    noisy /= np.linalg.norm(noisy, axis=-1, keepdims=True)
    off = [degrees_off(averaged_normals(noisy, faces, passes), true).mean() for passes in (0, 1, 4)]
    assert off[0] == pytest.approx(degrees_off(noisy, true).mean(), abs=1e-4)
    assert off[1] < 0.5 * off[0] and off[2] < 0.6 * off[1]
    assert degrees_off(averaged_normals(true, faces, 4), true).max() < 1


def test_where_neighbours_cancel_out_a_normal_stays() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    normals = np.array([[0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, -1]], np.float32)
    averaged = averaged_normals(normals, faces, 1)
    # corners 0 and 2 have all four in reach, which cancel out; 1 and 3 have two up, one down
    np.testing.assert_array_equal(averaged[[0, 2]], normals[[0, 2]])
    np.testing.assert_allclose(averaged[[1, 3]], [[0, 0, 1]] * 2, atol=1e-6)
