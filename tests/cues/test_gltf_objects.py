"""GLB objects: axes, size, materials, and every kind of broken one named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from illuminerf.cues.object_files import load_object
from illuminerf.cues.variations import varied
from illuminerf.workflow.errors import UserError


def write(path: Path, mesh: trimesh.Trimesh, **material: Any) -> Path:
    uv = mesh.vertices[:, :2] - mesh.vertices[:, :2].min(0)
    if material:
        mesh.visual = TextureVisuals(uv=uv, material=PBRMaterial(**material))
    path.write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True))
    return path


def load(path: Path, seed: int = 0) -> Any:
    return load_object(path, np.random.default_rng(seed))


def test_y_up_becomes_z_up_in_the_unit_sphere(tmp_path: Path) -> None:
    cone = trimesh.creation.cone(radius=1.0, height=6.0)  # along +z of the file, so along -y of our world
    cone.apply_translation([5, 7, 9])
    ((mesh, _),) = load(write(tmp_path / "cone.glb", cone, baseColorFactor=[0.5, 0.5, 0.5, 1.0]))
    used = mesh.vertices[np.unique(mesh.faces)]
    assert np.linalg.norm(used, axis=1).max() == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose((used.max(0) + used.min(0)) / 2, 0, atol=1e-5)
    tip = used[np.argmin(used[:, 1])]
    assert tip[1] < -0.8 and abs(tip[0]) + abs(tip[2]) < 1e-3
    assert (used[:, 1] < -0.8).sum() < (used[:, 1] > 0.8).sum()


def test_textures_and_factors(tmp_path: Path) -> None:
    color = Image.new("RGB", (4, 4), (188, 0, 0))  # sRGB 188 is linear 0.5
    other = Image.new("RGB", (2, 2), (0, 128, 255))
    path = write(
        tmp_path / "box.glb",
        trimesh.creation.box(),
        baseColorTexture=color,
        metallicRoughnessTexture=other,
        roughnessFactor=0.5,
        metallicFactor=0.8,
    )
    ((_, material),) = load(path)
    assert material.is_textured
    np.testing.assert_allclose(np.asarray(material.base_color)[0, 0], [0.503, 0, 0], atol=2e-3)
    np.testing.assert_allclose(material.roughness, 0.5 * 128 / 255, atol=1e-3)
    np.testing.assert_allclose(material.metallic, 0.8, atol=1e-3)


def test_bare_geometry_gets_a_random_material(tmp_path: Path) -> None:
    path = write(tmp_path / "bare.glb", trimesh.creation.box())
    first, again, other = (load(path, seed)[0][1] for seed in (0, 0, 1))
    assert first == again and first != other
    assert 0.02 <= first.roughness <= 0.5 and 0 <= first.metallic <= 1


def test_broken_objects_are_named(tmp_path: Path) -> None:
    glass = write(tmp_path / "glass.glb", trimesh.creation.box(), alphaMode="BLEND", baseColorFactor=[1.0, 0, 0, 0.3])
    with pytest.raises(UserError, match="glass.glb is .*transparent"):
        load(glass)
    (tmp_path / "noise.glb").write_bytes(b"not a model")
    with pytest.raises(UserError, match="noise.glb is unreadable"):
        load(tmp_path / "noise.glb")
    truncated = glass.read_bytes()[:200]
    (tmp_path / "cut.glb").write_bytes(truncated)
    with pytest.raises(UserError, match="cut.glb"):
        load(tmp_path / "cut.glb")
    point = trimesh.Trimesh(np.ones((3, 3)), [[0, 1, 2]], process=False)
    with pytest.raises(UserError, match="point.glb has no extent"):
        load(write(tmp_path / "point.glb", point))


def test_variation_keeps_shape_and_range(tmp_path: Path) -> None:
    parts = load(write(tmp_path / "box.glb", trimesh.creation.box(), baseColorFactor=[0.5, 0.4, 0.3, 1.0]))
    seen = [varied(parts, np.random.default_rng(seed))[0] for seed in range(40)]
    assert all(mesh is parts[0][0] for mesh, _ in seen)
    assert 10 < sum(material.roughness != parts[0][1].roughness for _, material in seen) < 35
    assert len({tuple(np.round(material.base_color, 6)) for _, material in seen}) > 10
    assert {material.metallic for _, material in seen} >= {0.0, 1.0}
