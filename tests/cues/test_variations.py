"""Variations exchange what an object is made of, never its shape."""

import numpy as np

from illuminerf.cues.materials import Material
from illuminerf.cues.variations import varied
from illuminerf.scene.meshes import sphere_mesh


def test_variation_keeps_shape_and_range() -> None:
    parts = [(sphere_mesh(1), Material((0.5, 0.4, 0.3)))]
    seen = [varied(parts, np.random.default_rng(seed))[0] for seed in range(40)]
    assert all(mesh is parts[0][0] for mesh, _ in seen)
    assert 10 < sum(material.roughness != parts[0][1].roughness for _, material in seen) < 35
    assert len({tuple(np.round(material.base_color, 6)) for _, material in seen}) > 10
    assert {material.metallic for _, material in seen} >= {0.0, 1.0}
