"""Texture atlas, unlit GLB, coloured PLY: read back by an independent reader, colours where they belong."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from illuminerf.scene.coloured_meshes import save_coloured_glb, save_coloured_ply, save_textured_glb
from illuminerf.scene.images import linear_from_srgb
from illuminerf.scene.meshes import GLTF_FROM_WORLD, TriangleMesh, sphere_mesh
from illuminerf.scene.triangle_atlas import TriangleAtlas
from illuminerf.workflow.errors import UserError


def colour_at(positions: np.ndarray) -> np.ndarray:
    """A colour that is linear in space, so that interpolation is exact."""
    return 0.5 + 0.4 * positions


def painted(mesh: TriangleMesh, atlas: TriangleAtlas) -> np.ndarray:
    face, barycentric = atlas.texels_of_cells(np.arange(atlas.num_cells))
    positions = np.einsum("ctk,ctkx->ctx", barycentric, mesh.vertices[mesh.faces][face])
    return atlas.picture(colour_at(positions)).astype(np.float32)


def bilinear(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """What a viewer samples; uv (0, 0) is the upper left corner of the upper left texel."""
    x, y = uv[:, 0] * picture.shape[1] - 0.5, uv[:, 1] * picture.shape[0] - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    result = np.zeros((len(uv), picture.shape[2]))
    for dy in (0, 1):
        for dx in (0, 1):
            weight = (1 - np.abs(x - left - dx)) * (1 - np.abs(y - top - dy))
            row, column = (np.clip(top + dy, 0, len(picture) - 1), np.clip(left + dx, 0, picture.shape[1] - 1))
            result += weight[:, None] * picture[row, column]
    return result


@pytest.mark.parametrize("texels", [1, 2, 5])
@pytest.mark.parametrize("subdivisions", [0, 2])
def test_every_point_of_every_triangle_is_sampled_from_its_own_texels(texels: int, subdivisions: int) -> None:
    mesh = sphere_mesh(subdivisions)
    atlas = TriangleAtlas(len(mesh.faces), texels)
    generator = np.random.default_rng(0)
    shares = generator.dirichlet(np.ones(3), len(mesh.faces)).astype(np.float32)
    places = np.einsum("fk,fkx->fx", shares, mesh.vertices[mesh.faces])
    uv = np.einsum("fk,fkx->fx", shares, atlas.corners())
    sampled = bilinear(painted(mesh, atlas), uv)
    np.testing.assert_allclose(sampled, colour_at(places), atol=2e-3)
    shuffled = bilinear(painted(mesh, atlas), np.einsum("fk,fkx->fx", shares, atlas.corners()[::-1]))
    assert np.abs(shuffled - colour_at(places)).max() > 0.1, "a wrong place must show"


def test_texels_of_an_odd_number_of_triangles_fill_the_picture() -> None:
    atlas = TriangleAtlas(7, 2)
    face, _ = atlas.texels_of_cells(np.arange(atlas.num_cells))
    assert set(face.ravel()) == set(range(7))
    assert atlas.picture(np.zeros((4, 25, 3))).shape == (10, 10, 3)


def test_glb_is_unlit_y_up_and_its_texture_is_srgb(tmp_path: Path) -> None:
    mesh = sphere_mesh(2)
    atlas = TriangleAtlas(len(mesh.faces), 2)
    save_textured_glb(tmp_path / "a.glb", mesh, atlas, painted(mesh, atlas))
    raw = (tmp_path / "a.glb").read_bytes()
    assert b"KHR_materials_unlit" in raw and raw[:4] == b"glTF" and int.from_bytes(raw[8:12], "little") == len(raw)
    (read,) = trimesh.load_scene(tmp_path / "a.glb", process=False).geometry.values()
    np.testing.assert_allclose(
        np.asarray(read.vertices), mesh.vertices[mesh.faces].reshape(-1, 3) @ GLTF_FROM_WORLD.T, atol=1e-6
    )
    # trimesh turns v over, as programs with the origin below do
    uv = np.asarray(read.visual.uv) * [1, -1] + [0, 1]
    picture = np.asarray(read.visual.material.baseColorTexture.convert("RGB"), np.float32) / 255
    world = np.asarray(read.vertices) @ GLTF_FROM_WORLD
    np.testing.assert_allclose(bilinear(picture, uv), colour_at(world), atol=6e-3)
    assert np.abs(bilinear(picture, uv) - colour_at(np.asarray(read.vertices))).max() > 0.1, "axes must matter"


def test_vertex_colours_are_linear_as_gltf_demands(tmp_path: Path) -> None:
    mesh = sphere_mesh(2)
    srgb = colour_at(mesh.vertices)
    save_coloured_glb(tmp_path / "a.glb", TriangleMesh(mesh.vertices, mesh.faces, mesh.vertex_normals, srgb))
    (read,) = trimesh.load_scene(tmp_path / "a.glb", process=False).geometry.values()
    np.testing.assert_allclose(np.asarray(read.vertices) @ GLTF_FROM_WORLD, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    raw = (tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(raw[12:16], "little")
    assert b"KHR_materials_unlit" in raw[:length]
    start = 20 + length + 8 + mesh.vertices.size * 4
    stored = np.frombuffer(raw, "<u2", len(mesh.vertices) * 4, start).reshape(-1, 4) / 65535
    np.testing.assert_allclose(stored[:, :3], linear_from_srgb(srgb), atol=1e-4)
    assert np.abs(stored[:, :3] - srgb).max() > 0.1 and (stored[:, 3] == 1).all()


def test_every_buffer_view_says_what_it_is_for(tmp_path: Path) -> None:
    mesh = sphere_mesh(1)
    atlas = TriangleAtlas(len(mesh.faces))
    save_textured_glb(tmp_path / "textured.glb", mesh, atlas, painted(mesh, atlas))
    coloured = TriangleMesh(mesh.vertices, mesh.faces, mesh.vertex_normals, colour_at(mesh.vertices))
    save_coloured_glb(tmp_path / "coloured.glb", coloured)
    targets = {}
    for name in ("textured", "coloured"):
        raw = (tmp_path / f"{name}.glb").read_bytes()
        document = json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])
        targets[name] = [view.get("target") for view in document["bufferViews"]]
    vertices, indices, picture = 34962, 34963, None
    assert targets == {"textured": [vertices, vertices, picture], "coloured": [vertices, vertices, indices]}


def test_glb_is_read_by_our_own_reader(tmp_path: Path) -> None:
    mesh = sphere_mesh(1)
    atlas = TriangleAtlas(len(mesh.faces))
    save_textured_glb(tmp_path / "a.glb", mesh, atlas, painted(mesh, atlas))
    np.testing.assert_allclose(
        TriangleMesh.load_glb(tmp_path / "a.glb").vertices, mesh.vertices[mesh.faces].reshape(-1, 3), atol=1e-6
    )


def test_ply_has_colours_and_normals_and_keeps_our_axes(tmp_path: Path) -> None:
    mesh = sphere_mesh(2)
    coloured = TriangleMesh(mesh.vertices, mesh.faces, mesh.vertex_normals, colour_at(mesh.vertices))
    save_coloured_ply(tmp_path / "a.ply", coloured)
    read = trimesh.load_mesh(tmp_path / "a.ply", process=False)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_allclose(read.visual.vertex_colors[:, :3] / 255, colour_at(mesh.vertices), atol=0.5 / 255 + 1e-6)
    body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1]
    first = np.frombuffer(body[:24], "<f4")  # trimesh makes normals of its own
    np.testing.assert_allclose(first, [*mesh.vertices[0], *mesh.vertex_normals[0]], atol=1e-6)


def test_a_texture_beyond_what_viewers_take_is_refused() -> None:
    with pytest.raises(UserError, match="too large"):
        TriangleAtlas(2_000_000, 20)
