"""A painted mesh looks like the field it was painted from."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

from illuminerf.scene.meshes import GLTF_FROM_WORLD
from illuminerf.stages import bake_relit_mesh
from illuminerf.workflow.errors import UserError

CONFIG = bake_relit_mesh.Config(device="cpu")


def colour_of(places: np.ndarray) -> np.ndarray:
    """The sphere's colour in tests/stages/conftest.py."""
    on_sphere = places / np.linalg.norm(places, axis=-1, keepdims=True)
    return np.clip(0.5 + 0.3 * np.sin(2 * on_sphere + np.array([0, 1, 2])), 0, 1)


@pytest.mark.parametrize("texels", [1, 2])
def test_colours_are_where_the_photographs_saw_them(
    sphere_geometry: Path, sphere_capture: Path, tmp_path: Path, texels: int
) -> None:
    config = dataclasses.replace(CONFIG, texels_per_edge=texels)
    out = bake_relit_mesh.run(sphere_geometry, sphere_geometry, sphere_capture, config, tmp_path / "baked")
    ply = trimesh.load_mesh(out / "relit.ply", process=False)
    painted = ply.visual.vertex_colors[:, :3] / 255
    assert np.sqrt(np.mean((painted - colour_of(ply.vertices)) ** 2)) < 0.08
    assert np.sqrt(np.mean((painted - colour_of(-ply.vertices)) ** 2)) > 0.2
    (plain,) = trimesh.load_scene(out / "relit.glb", process=False).geometry.values()
    np.testing.assert_allclose(np.asarray(plain.vertices) @ GLTF_FROM_WORLD, ply.vertices, atol=1e-5)
    (glb,) = trimesh.load_scene(out / "textured.glb", process=False).geometry.values()
    picture = np.asarray(glb.visual.material.baseColorTexture.convert("RGB"), np.float32) / 255
    uv = np.asarray(glb.visual.uv) * [1, -1] + [0, 1]
    x, y = np.floor(uv * [picture.shape[1], picture.shape[0]]).astype(int).T
    world = np.asarray(glb.vertices) @ GLTF_FROM_WORLD
    assert np.sqrt(np.mean((picture[y, x] - colour_of(world)) ** 2)) < 0.08
    assert bake_relit_mesh.run(sphere_geometry, sphere_geometry, sphere_capture, config, out) == out


def test_impossible_settings() -> None:
    with pytest.raises(UserError, match="positive"):
        bake_relit_mesh.Config(num_directions=0)
