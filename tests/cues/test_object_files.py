"""glTF objects: axes, sizes, transforms, normals and materials."""

import io
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from illuminerf.cues.materials import Parts
from illuminerf.cues.object_files import MissingMaterials, ObjectReading, load_object
from illuminerf.cues.raw_objects import ReadingLimits
from illuminerf.cues.texture_baking import baked
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError
from tests.cues.made_objects import FACES, TETRAHEDRON, UV, Gltf, png

RED = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.1, 0.1, 1.0], "roughnessFactor": 0.7, "metallicFactor": 0.0}}


def load(path: Path, seed: int = 0, **config: Any) -> Parts:
    return load_object(path, np.random.default_rng(seed), ObjectReading(**config))


def flat_normals(mesh: TriangleMesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    crossed = np.cross(b - a, c - a)
    return crossed / np.linalg.norm(crossed, axis=1, keepdims=True)


def outwardness(mesh: TriangleMesh) -> float:
    """Signed volume: positive where faces are counter-clockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def test_y_up_becomes_z_up_in_the_unit_sphere(tmp_path: Path) -> None:
    tall = TETRAHEDRON * [1, 5, 1] + [5, 7, 9]
    ((mesh, _),) = load(Gltf().mesh(tall, material=RED).glb(tmp_path / "a.glb"))
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(mesh.vertices.max(0) + mesh.vertices.min(0), 0, atol=1e-6)
    size = np.ptp(mesh.vertices, axis=0)
    assert size[2] == pytest.approx(5 * size[0], rel=1e-5) and size[1] == pytest.approx(size[0], rel=1e-5)
    top = mesh.vertices[mesh.vertices[:, 2].argmax()]  # (0, 5, 0): least x, and least z, which is greatest y of ours
    assert top[0] == mesh.vertices[:, 0].min() and top[1] == mesh.vertices[:, 1].max()


def test_external_buffers_and_images_equal_embedded_ones(tmp_path: Path) -> None:
    def made(image: bytes | str) -> Gltf:
        gltf = Gltf()
        return gltf.mesh(material={"pbrMetallicRoughness": {"baseColorTexture": gltf.texture(image)}}, TEXCOORD_0=UV)

    (tmp_path / "red wood.png").write_bytes(png((200, 10, 10)))
    ((mesh, material),) = load(made("red%20wood.png").gltf(tmp_path / "a.gltf"))
    ((same, as_before),) = load(made(png((200, 10, 10))).glb(tmp_path / "a.glb"))
    np.testing.assert_array_equal(mesh.vertices, same.vertices)
    np.testing.assert_array_equal(material.base_color, as_before.base_color)
    np.testing.assert_array_equal(material.uv, as_before.uv)


@pytest.mark.parametrize("scale", [[2, 2, 2], [-1, 1, 1], [-1, -1, 1], [-3, 1, -2], [-1, -1, -1]])
def test_mirroring_transforms_keep_the_outside_outside(tmp_path: Path, scale: list[float]) -> None:
    normals = TETRAHEDRON - TETRAHEDRON.mean(0)
    node = {"scale": scale, "rotation": [0, 0.6, 0, 0.8], "translation": [3, 2, 1]}
    for given in ({"NORMAL": normals.astype(np.float32)}, {}):
        ((mesh, _),) = load(Gltf().mesh(material=RED, node=node, **given).glb(tmp_path / "a.glb"))
        assert outwardness(mesh) > 0.01
        assert (np.einsum("fi,fci->f", flat_normals(mesh), mesh.vertex_normals[mesh.faces]) > 0).all()


def test_transforms_go_down_the_tree(tmp_path: Path) -> None:
    """Two instances of one mesh, one under a parent that moves it by matrix."""
    gltf = Gltf().mesh(material=RED)
    matrix = np.eye(4)
    matrix[:3, 3] = [10, 0, 0]
    gltf.json["nodes"] += [{"mesh": 0, "scale": [2, 2, 2]}, {"children": [1], "matrix": matrix.T.ravel().tolist()}]
    gltf.json["scenes"], gltf.json["scene"] = [{"nodes": [0, 2]}], 0
    ((mesh, _),) = load(gltf.glb(tmp_path / "a.glb"))
    assert len(mesh.faces) == 2 * len(FACES)
    size = np.ptp(mesh.vertices, axis=0)
    assert size[0] / size[2] == pytest.approx(12 / 2, rel=1e-5)  # from 0 to 10 + 2, twice the height of 1


def test_instances_far_off_keep_their_shape(tmp_path: Path) -> None:
    """Placed in double precision: in single precision a step is 64 at 1e9."""
    far = {"translation": [1e9, -1e9, 1e9]}
    ((near, _),) = load(Gltf().mesh(material=RED).glb(tmp_path / "a.glb"))
    ((mesh, _),) = load(Gltf().mesh(material=RED, node=far).glb(tmp_path / "b.glb"))
    np.testing.assert_allclose(mesh.vertices, near.vertices, atol=1e-6)
    assert not np.allclose((TETRAHEDRON + np.float32(1e9)) - np.float32(1e9), TETRAHEDRON)


@pytest.mark.parametrize("size", [1e-20, 1e20])
def test_absurd_scales_are_normalised(tmp_path: Path, size: float) -> None:
    ((near, _),) = load(Gltf().mesh(material=RED).glb(tmp_path / "a.glb"))
    for made in (
        Gltf().mesh(TETRAHEDRON * np.float32(size), material=RED),
        Gltf().mesh(material=RED, node={"scale": [size] * 3}),
    ):
        ((mesh, _),) = load(made.glb(tmp_path / "b.glb"))
        np.testing.assert_allclose(mesh.vertices, near.vertices, atol=1e-5)


def test_normals_without_any_given(tmp_path: Path) -> None:
    """Creases stay sharp, smooth surfaces are smooth, seams of the texture do not show."""
    box, ball = trimesh.creation.box(), trimesh.creation.icosphere(3)
    ((mesh, _),) = load(Gltf().mesh(box.vertices, box.faces, RED).glb(tmp_path / "box.glb"))
    corner = mesh.vertex_normals[mesh.faces]
    np.testing.assert_allclose(corner, np.broadcast_to(flat_normals(mesh)[:, None], corner.shape), atol=1e-6)
    split = ball.vertices[ball.faces].reshape(-1, 3)  # every face with vertices of its own
    ((mesh, _),) = load(Gltf().mesh(split, np.arange(len(split)).reshape(-1, 3), RED).glb(tmp_path / "ball.glb"))
    np.testing.assert_allclose(mesh.vertex_normals, mesh.vertices, atol=0.02)
    assert np.abs(flat_normals(mesh) - mesh.vertices[mesh.faces[:, 0]]).max() > 0.05


def test_winding_follows_the_normals(tmp_path: Path) -> None:
    outward = (TETRAHEDRON - TETRAHEDRON.mean(0)).astype(np.float32)
    ((mesh, _),) = load(Gltf().mesh(faces=FACES[:, ::-1], material=RED, NORMAL=outward).glb(tmp_path / "a.glb"))
    assert outwardness(mesh) > 0


def test_useless_normals_are_replaced(tmp_path: Path) -> None:
    constant = np.tile(np.float32([0, 1, 0]), (4, 1))
    broken = np.float32([[np.nan, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 1]])
    for normals in (constant, broken):
        ((mesh, _),) = load(Gltf().mesh(material=RED, NORMAL=normals).glb(tmp_path / "a.glb"))
        np.testing.assert_allclose(np.linalg.norm(mesh.vertex_normals, axis=1), 1, atol=1e-5)
        assert len(np.unique(np.round(mesh.vertex_normals, 3), axis=0)) > 2


def test_textures_times_factors(tmp_path: Path) -> None:
    gltf = Gltf()
    pbr = {
        "baseColorTexture": gltf.texture(png((188, 0, 255))),  # sRGB 188 is linear 0.503
        "metallicRoughnessTexture": gltf.texture(png((7, 128, 255), 2)),
        "baseColorFactor": [0.5, 1, 0.25, 1],
        "roughnessFactor": 0.5,
        "metallicFactor": 0.8,
    }
    ((_, material),) = load(gltf.mesh(material={"pbrMetallicRoughness": pbr}, TEXCOORD_0=UV).glb(tmp_path / "a.glb"))
    assert material.is_textured and material.normal_map is None
    np.testing.assert_allclose(np.asarray(material.base_color)[0, 0], [0.2514, 0, 0.25], atol=1e-3)
    np.testing.assert_allclose(material.roughness, 0.5 * 128 / 255, atol=1e-3)
    np.testing.assert_allclose(material.metallic, 0.8, atol=1e-3)


def test_pictures_stand_upright(tmp_path: Path) -> None:
    """glTF's v = 0 is the top row; ours the bottom."""
    gltf = Gltf()
    material = {"pbrMetallicRoughness": {"baseColorTexture": gltf.texture(png((9, 9, 9)))}}
    ((mesh, made),) = load(gltf.mesh(material=material, TEXCOORD_0=UV * 0.5).glb(tmp_path / "a.glb"))
    assert made.uv is not None
    wanted = UV * [0.5, -0.5] + [0, 1]
    np.testing.assert_allclose(np.unique(made.uv, axis=0), np.unique(wanted, axis=0), atol=1e-6)


def test_texture_transforms(tmp_path: Path) -> None:
    gltf = Gltf()
    info: dict[str, Any] = gltf.texture(png((9, 9, 9)))
    info["extensions"] = {"KHR_texture_transform": {"scale": [0.5, 0.25], "offset": [0.1, 0.2], "rotation": np.pi / 2}}
    normals = (TETRAHEDRON - TETRAHEDRON.mean(0)).astype(np.float32)
    gltf.mesh(material={"pbrMetallicRoughness": {"baseColorTexture": info}}, TEXCOORD_0=UV, NORMAL=normals)
    ((_, made),) = load(gltf.glb(tmp_path / "a.glb"))
    u, v = UV[:, 0] * 0.5, UV[:, 1] * 0.25
    wanted = np.stack([v + 0.1, 1 - (-u + 0.2)], -1)  # turned counter-clockwise as seen with v downward
    assert made.uv is not None
    np.testing.assert_allclose((made.uv - wanted) % 1 % (1 - 1e-6), 0, atol=1e-5)


def test_normal_maps_and_their_scale(tmp_path: Path) -> None:
    gltf = Gltf()
    normal: dict[str, Any] = gltf.texture(png((128, 218, 218)))  # 45 degrees toward +v
    gltf.mesh(material={**RED, "normalTexture": {**normal, "scale": 0.5}}, TEXCOORD_0=UV)
    ((_, material),) = load(gltf.glb(tmp_path / "a.glb"))
    assert material.normal_map is not None
    np.testing.assert_allclose(material.normal_map[0, 0], np.array([0, 0.5, 1]) / np.sqrt(1.25), atol=5e-3)
    np.testing.assert_allclose(np.asarray(material.base_color)[0, 0], [0.5, 0.1, 0.1], atol=1e-6)


def test_vertex_colours_multiply_in_linear(tmp_path: Path) -> None:
    colors = np.linspace(0, 1, 12, dtype=np.float32).reshape(4, 3)
    normals = (TETRAHEDRON - TETRAHEDRON.mean(0)).astype(np.float32)
    gltf = Gltf()
    ((_, material),) = load(gltf.mesh(material=RED, NORMAL=normals, COLOR_0=colors).glb(tmp_path / "a.glb"))
    np.testing.assert_allclose(material.base_color, colors * [0.5, 0.1, 0.1], atol=1e-6)
    gltf = Gltf()
    coded = gltf.accessor(np.round(colors * 255).astype(np.uint8).repeat(1, 0), normalized=True)
    ((_, material),) = load(gltf.mesh(material=RED, NORMAL=normals, COLOR_0=coded).glb(tmp_path / "b.glb"))
    np.testing.assert_allclose(material.base_color, colors * [0.5, 0.1, 0.1], atol=3e-3)


@pytest.mark.parametrize("is_constant", [True, False])
def test_vertex_colours_times_textures(tmp_path: Path, is_constant: bool) -> None:
    gltf = Gltf()
    texture = gltf.texture(png((255, 255, 0)))
    colors = (
        np.float32([[0.5, 0.25, 1]] * 4)
        if is_constant
        else np.float32([[0.2, 0, 0], [0.4, 0, 0], [0.6, 0, 0], [0.8, 0, 0]])
    )
    material = {"pbrMetallicRoughness": {"baseColorTexture": texture}}
    ((mesh, made),) = load(gltf.mesh(material=material, TEXCOORD_0=UV, COLOR_0=colors).glb(tmp_path / "a.glb"))
    assert made.is_textured == is_constant
    if is_constant:
        np.testing.assert_allclose(np.asarray(made.base_color)[0, 0], [0.5, 0.25, 0], atol=1e-6)
        return
    # red is linear in the position by construction: 0.2 + 0.2 x + 0.4 y + 0.6 z of the file
    found = np.asarray(made.base_color)
    corner = mesh.vertices.min(0)
    local = (mesh.vertices - [corner[0], mesh.vertices[:, 1].max(), corner[2]]) / np.ptp(mesh.vertices, axis=0)
    np.testing.assert_allclose(found[:, 0], 0.2 + 0.2 * local[:, 0] + 0.4 * local[:, 2] - 0.6 * local[:, 1], atol=1e-4)


def test_materials_keep_apart_and_are_shared(tmp_path: Path) -> None:
    gltf = (
        Gltf()
        .mesh(material=RED)
        .mesh(TETRAHEDRON + 2, material={"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 1, 1]}})
    )
    gltf.mesh(TETRAHEDRON + 4, primitive={"material": 0})
    parts = load(gltf.glb(tmp_path / "a.glb"))
    assert [len(mesh.faces) for mesh, _ in parts] == [8, 4]
    np.testing.assert_allclose(parts[0][1].base_color, [0.5, 0.1, 0.1])
    # the standard's own defaults, where a material says something but not this
    assert (parts[1][1].roughness, parts[1][1].metallic) == (1.0, 1.0)


def test_specular_glossiness_is_converted(tmp_path: Path) -> None:
    def found(**old: Any) -> Any:
        material = {"extensions": {"KHR_materials_pbrSpecularGlossiness": old}}
        return load(Gltf().mesh(material=material).glb(tmp_path / "a.glb"))[0][1]

    plastic = found(diffuseFactor=[0.6, 0.3, 0.1, 1], specularFactor=[0.04, 0.04, 0.04], glossinessFactor=0.3)
    np.testing.assert_allclose(plastic.base_color, [0.6, 0.3, 0.1], atol=5e-3)
    assert plastic.metallic == pytest.approx(0, abs=0.01) and plastic.roughness == pytest.approx(0.7)
    gold = found(diffuseFactor=[0, 0, 0, 1], specularFactor=[1, 0.7, 0.3], glossinessFactor=0.8)
    np.testing.assert_allclose(gold.base_color, [1, 0.7, 0.3], atol=0.02)
    assert gold.metallic > 0.95 and gold.roughness == pytest.approx(0.2)


def test_nothing_but_geometry_gets_a_random_material(tmp_path: Path) -> None:
    path = Gltf().mesh().glb(tmp_path / "bare.glb")
    first, again, other = (load(path, seed)[0][1] for seed in (0, 0, 1))
    assert first == again and first != other
    seen = [load(path, seed)[0][1] for seed in range(60)]
    colors = np.array([material.base_color for material in seen])
    roughness = np.array([material.roughness for material in seen])
    mix = np.array([material.metallic for material in seen])
    assert colors.min() < 0.1 and colors.max() > 0.9 and abs(colors.mean() - 0.5) < 0.1
    assert 0.02 <= roughness.min() < 0.1 and 0.42 < roughness.max() <= 0.5
    assert mix.min() < 0.1 and mix.max() > 0.9
    narrow = MissingMaterials(min_albedo=0.3, max_albedo=0.4, min_roughness=0.1, max_roughness=0.1, max_mix=0.0)
    material = load(path, missing=narrow)[0][1]
    assert min(material.base_color) >= 0.3 and max(material.base_color) <= 0.4
    assert (material.roughness, material.metallic) == (pytest.approx(0.1), 0)


def test_what_is_missing_is_told_apart(tmp_path: Path) -> None:
    """A material that says nothing: diffuse. One that has a lobe but no colour: its lobe. Colours only: a lobe."""
    silent = load(Gltf().mesh(material={"doubleSided": True}).glb(tmp_path / "a.glb"))[0][1]
    assert (silent.roughness, silent.metallic) == (1, 0) and max(silent.base_color) < 1
    lobe = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1], "roughnessFactor": 0.3, "metallicFactor": 1}}
    shiny = load(Gltf().mesh(material=lobe).glb(tmp_path / "b.glb"))[0][1]
    assert (shiny.roughness, shiny.metallic) == (pytest.approx(0.3), 1) and max(shiny.base_color) < 1
    colors = np.tile(np.float32([0.2, 0.4, 0.6]), (4, 1))
    painted = load(Gltf().mesh(COLOR_0=colors).glb(tmp_path / "c.glb"))[0][1]
    np.testing.assert_allclose(painted.base_color, [0.2, 0.4, 0.6], atol=1e-6)
    assert 0.02 <= painted.roughness <= 0.5
    # white beside other colours is meant
    both = Gltf().mesh(material=RED).mesh(TETRAHEDRON + 2, material=lobe)
    np.testing.assert_allclose(load(both.glb(tmp_path / "d.glb"))[1][1].base_color, 1)


def test_large_textures_are_averaged_in_linear_light(tmp_path: Path) -> None:
    checker = np.where((np.indices((64, 64)).sum(0) % 2)[..., None], 255, 0).astype(np.uint8).repeat(3, -1)
    out = io.BytesIO()
    Image.fromarray(checker).save(out, "PNG")
    gltf = Gltf()
    texture = gltf.texture(out.getvalue())
    path = gltf.mesh(material={"pbrMetallicRoughness": {"baseColorTexture": texture}}, TEXCOORD_0=UV).glb(
        tmp_path / "a.glb"
    )
    color = np.asarray(load(path, limits=ReadingLimits(max_texture_side=16))[0][1].base_color)
    assert color.shape == (16, 16, 3)
    np.testing.assert_allclose(color, 0.5, atol=1e-3)  # in sRGB values the mean would be 0.21


def test_strips_and_fans(tmp_path: Path) -> None:
    square = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    ((strip, _),) = load(Gltf().mesh(square, np.array([0, 1, 2, 3]), RED, {"mode": 5}).glb(tmp_path / "a.glb"))
    ((fan, _),) = load(Gltf().mesh(square, np.array([0, 1, 3, 2]), RED, {"mode": 6}).glb(tmp_path / "b.glb"))
    for mesh in (strip, fan):
        assert len(mesh.faces) == 2
        np.testing.assert_allclose(flat_normals(mesh), [[0, -1, 0]] * 2, atol=1e-6)


def test_skins_stand_in_their_rest_pose(tmp_path: Path) -> None:
    """The joint moves the upper half; the node's own transform does not count."""
    gltf = Gltf()
    joints = np.zeros((4, 4), np.uint8)
    joints[2, 0] = 1
    weights = np.tile(np.float32([1, 0, 0, 0]), (4, 1))
    node = {"skin": 0, "translation": [100, 0, 0], "scale": [9, 9, 9]}
    gltf.mesh(material=RED, node=node, JOINTS_0=joints, WEIGHTS_0=weights)
    bind = np.tile(np.eye(4, dtype=np.float32).ravel(), (2, 1))
    gltf.json["skins"] = [{"joints": [1, 2], "inverseBindMatrices": gltf.accessor(bind)}]
    gltf.json["nodes"] += [{}, {"translation": [0, 1, 0]}]
    ((mesh, _),) = load(gltf.glb(tmp_path / "a.glb"))
    size = np.ptp(mesh.vertices, axis=0)
    assert size[2] / size[0] == pytest.approx(2, rel=1e-5)  # (0, 1, 0) went up to (0, 2, 0)


def test_sparse_and_quantised_accessors(tmp_path: Path) -> None:
    gltf = Gltf().mesh(material=RED)
    rows, new = gltf.view(np.array([2], np.uint16).tobytes()), gltf.view(np.float32([[0, 7, 0]]).tobytes())
    gltf.json["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": rows, "componentType": 5123},
        "values": {"bufferView": new},
    }
    ((mesh, _),) = load(gltf.glb(tmp_path / "a.glb"))
    size = np.ptp(mesh.vertices, axis=0)
    assert size[2] / size[0] == pytest.approx(7, rel=1e-5)
    gltf = Gltf().mesh(material=RED)
    coded = np.zeros((4, 4), np.int16)  # padded to 8 bytes, as the extension wants
    coded[:, :3] = TETRAHEDRON * 1000
    view = gltf.view(coded.tobytes())
    gltf.json["bufferViews"][view]["byteStride"] = 8
    gltf.json["accessors"][0] = {"bufferView": view, "componentType": 5122, "count": 4, "type": "VEC3"}
    gltf.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    ((mesh, _),) = load(gltf.glb(tmp_path / "b.glb"))
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), np.ptp(mesh.vertices), rtol=1e-5)


def test_settings_are_checked() -> None:
    with pytest.raises(UserError, match="roughness of missing materials"):
        MissingMaterials(min_roughness=0.6)
    with pytest.raises(UserError, match="limits"):
        ReadingLimits(max_faces=0)


@pytest.mark.slow
def test_a_million_faces_in_bounded_time_and_memory(tmp_path: Path) -> None:
    """A textured, normal-mapped ball of a million faces is read and baked; measured: 9 s, 1.3 GB beyond the start."""
    side = 708
    azimuth, polar = np.meshgrid(np.linspace(0, 2 * np.pi, side), np.linspace(0.01, np.pi - 0.01, side))
    ball = np.stack([np.cos(azimuth) * np.sin(polar), np.cos(polar), np.sin(azimuth) * np.sin(polar)], -1)
    uv = np.stack([azimuth / (2 * np.pi), polar / np.pi], -1).reshape(-1, 2).astype(np.float32)
    index = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    gltf = Gltf()
    pbr = {"baseColorTexture": gltf.texture(png((9, 99, 200), 512))}
    material = {"pbrMetallicRoughness": pbr, "normalTexture": gltf.texture(png((128, 128, 255), 512))}
    path = gltf.mesh(ball.reshape(-1, 3), faces, material, TEXCOORD_0=uv).glb(tmp_path / "a.glb")
    tracemalloc.start()
    start = time.monotonic()
    ((mesh, made),) = baked(load(path))
    seconds, peak = time.monotonic() - start, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(mesh.faces) == len(faces) > 999_000 and not made.is_textured
    np.testing.assert_allclose(mesh.vertex_normals, mesh.vertices, atol=0.02)
    assert seconds < 120 and peak < 2e9
