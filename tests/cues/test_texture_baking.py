"""Splitting keeps the surface; baked colours are the texture's."""

import numpy as np

from illuminerf.cues.materials import Material
from illuminerf.cues.texture_baking import baked, split_to_edge
from illuminerf.scene.meshes import TriangleMesh


def areas(corners: np.ndarray) -> np.ndarray:
    a, b, c = corners[:, 0, :3], corners[:, 1, :3], corners[:, 2, :3]
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def square(color: np.ndarray) -> tuple[TriangleMesh, Material]:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    mesh = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.tile(np.float32([0, 0, 1]), (4, 1)))
    return mesh, Material(color, 0.3, 0.0, corners[:, :2])


def test_splitting_keeps_area_orientation_and_bounds_edges() -> None:
    corners = np.random.default_rng(0).normal(size=(20, 3, 5))
    split = split_to_edge(corners, 0.5)
    edges = np.linalg.norm(split[:, [1, 2, 0], :3] - split[:, :, :3], axis=-1)
    assert edges.max() <= 0.5
    np.testing.assert_allclose(areas(split).sum(), areas(corners).sum())
    assert len(split_to_edge(corners, 100.0)) == 20


def test_other_channels_are_interpolated_along() -> None:
    """Channels that are linear in the position stay so."""
    corners = np.random.default_rng(1).normal(size=(5, 3, 3))
    matrix = np.random.default_rng(2).normal(size=(3, 2))
    split = split_to_edge(np.concatenate([corners, corners @ matrix], -1), 0.3)
    np.testing.assert_allclose(split[..., 3:], split[..., :3] @ matrix, atol=1e-12)


def test_a_linear_texture_comes_back_at_the_vertices() -> None:
    ramp = np.broadcast_to((np.arange(64, dtype=np.float32) + 0.5)[None, :, None] / 64, (64, 64, 3)).copy()
    ramp[..., 1] = ramp[..., 1].T[::-1]  # grows upward: row 0 is the top, v = 1
    ((mesh, material),) = baked([square(ramp)], max_edge=0.1)
    inner = ((mesh.vertices[:, :2] > 0.1) & (mesh.vertices[:, :2] < 0.9)).all(1)
    assert inner.sum() > 100 and not material.is_textured
    np.testing.assert_allclose(np.asarray(material.base_color)[inner, 0], mesh.vertices[inner, 0], atol=0.02)
    np.testing.assert_allclose(np.asarray(material.base_color)[inner, 1], mesh.vertices[inner, 1], atol=0.02)
    np.testing.assert_allclose(material.roughness, 0.3, rtol=1e-5)


def test_fine_patterns_are_averaged_not_aliased() -> None:
    checker = (np.indices((256, 256)).sum(0) % 2).astype(np.float32)[..., None].repeat(3, -1)
    ((_, material),) = baked([square(checker)], max_edge=0.1)
    assert np.abs(np.asarray(material.base_color) - 0.5).max() < 0.05


def test_untextured_parts_pass_through() -> None:
    mesh, _ = square(np.ones((2, 2, 3), np.float32))
    part = (mesh, Material((0.1, 0.2, 0.3)))
    assert baked([part])[0][0] is mesh and baked([part])[0][1] is part[1]
