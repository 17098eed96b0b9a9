"""Variations: shape and range are kept, each switch works alone, and objects in one scene stand apart."""

from typing import Any

import numpy as np
import pytest
import trimesh

from illuminerf.cues.materials import Material
from illuminerf.cues.variations import MaterialVariation, changed, composed, swapped, varied
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.workflow.errors import UserError

BALL = sphere_mesh(2)


def box(extents: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> TriangleMesh:
    mesh = trimesh.creation.box(extents)
    mesh.unmerge_vertices()
    return TriangleMesh(
        np.asarray(mesh.vertices, np.float32),
        np.asarray(mesh.faces, np.int32),
        np.asarray(mesh.vertex_normals, np.float32),
    )


def checker() -> Material:
    image = np.kron(np.indices((4, 4)).sum(0) % 2, np.ones((8, 8)))[..., None] * np.array([0.9, 0.5, 0.1])
    return Material(image.astype(np.float32), 0.3, 0.0, np.zeros((3, 2), np.float32))


def another(generator: np.random.Generator) -> Any:
    return "crate", [(box(), checker())]


def test_materials_change_and_shapes_do_not() -> None:
    parts = [(BALL, Material((0.5, 0.4, 0.3), 0.5, 0.2))]
    results = [changed(parts, np.random.default_rng(seed)) for seed in range(60)]
    assert all(new[0][0] is BALL for new, _ in results)
    assert 15 < sum("roughness" in names for _, names in results) < 55
    assert {new[0][1].metallic for new, names in results if "metallic" in names} == {0.0, 1.0}
    assert all(new[0][1].roughness == 0.5 for new, names in results if "roughness" not in names)
    assert len({tuple(np.round(new[0][1].base_color, 6)) for new, _ in results}) > 20


def test_each_switch_works_alone() -> None:
    parts = [(BALL, Material())]
    only = {
        "change": (MaterialVariation(1.0, 0.0, 0.0), ("roughness", "metallic", "tint", "one colour")),
        "swap": (MaterialVariation(0.0, 1.0, 0.0), ("texture of crate",)),
        "compose": (MaterialVariation(0.0, 0.0, 1.0), ("beside crate", "beside crate, crate")),
    }
    for variation, allowed in only.values():
        names = [
            name for seed in range(12) for name in varied(parts, variation, np.random.default_rng(seed), another)[1]
        ]
        assert names and set(names) <= set(allowed)
    assert varied(parts, MaterialVariation.none(), np.random.default_rng(0), another) == (parts, [], [])


def test_switching_one_variation_off_leaves_the_others() -> None:
    parts = [(BALL, Material())]
    for seed in range(8):
        both = varied(parts, MaterialVariation(1.0, 1.0, 0.0), np.random.default_rng(seed), another)[1]
        alone = varied(parts, MaterialVariation(1.0, 0.0, 0.0), np.random.default_rng(seed), another)[1]
        assert both == ["texture of crate", *alone]


def test_a_broken_neighbour_is_not_used() -> None:
    parts = [(BALL, Material())]
    every = MaterialVariation(0.0, 1.0, 1.0)
    assert varied(parts, every, np.random.default_rng(0), lambda _: None) == (parts, [], [])


def test_a_borrowed_texture_lies_flat_on_every_side() -> None:
    ((mesh, material),) = swapped([(box(), Material())], checker())
    assert material.is_textured and material.uv is not None and len(material.uv) == len(mesh.vertices) == 36
    for face in mesh.faces:
        a, b, c = (material.uv[i] for i in face)
        area = abs(np.cross(b - a, c - a)) / 2
        assert area == pytest.approx(0.125, abs=1e-6)  # a half of the unit square, in units of two
    assert material.uv.min() >= 0 and material.uv.max() <= 1


def test_objects_stand_side_by_side_on_one_ground() -> None:
    for seed in range(6):
        objects = [[(BALL, Material((0.1, 0.1, 0.1)))], [(box(), Material())], [(box((0.2, 0.2, 2.0)), Material())]]
        parts = composed(objects, np.random.default_rng(seed))
        points = [mesh.vertices for mesh, _ in parts]
        lowest = [float(p[:, 2].min()) for p in points]
        assert np.ptp(lowest) < 1e-5
        reach = np.linalg.norm(np.concatenate(points), axis=1).max()
        assert reach == pytest.approx(1, abs=1e-5)
        middles = [(p[:, :2].min(0) + p[:, :2].max(0)) / 2 for p in points]
        radii = [np.linalg.norm(p[:, :2] - m, axis=1).max() for p, m in zip(points, middles, strict=True)]
        for i in range(3):
            for j in range(i):
                assert np.linalg.norm(middles[i] - middles[j]) > (radii[i] + radii[j]) * 0.99
        np.testing.assert_allclose(np.linalg.norm(parts[1][0].vertex_normals, axis=1), 1, atol=1e-5)


def test_wrong_probabilities_are_explained() -> None:
    with pytest.raises(UserError, match="got 0.5, 1.5, 0.15; wanted values in"):
        MaterialVariation(swap_probability=1.5)
