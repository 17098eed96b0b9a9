import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.workflow.errors import UserError
from tests.cues.made_objects import FACES, UV, Gltf, png


def test_glb_round_trip_is_exact_and_stands_upright(tmp_path: Path) -> None:
    sphere = sphere_mesh(2)
    stretched = TriangleMesh(sphere.vertices * np.float32([1, 2, 3]), sphere.faces, sphere.vertex_normals)
    stretched.save_glb(tmp_path / "mesh.glb")
    again = TriangleMesh.load_glb(tmp_path / "mesh.glb")
    np.testing.assert_array_equal(again.vertices, stretched.vertices)
    np.testing.assert_array_equal(again.vertex_normals, stretched.vertex_normals)
    np.testing.assert_array_equal(again.faces, stretched.faces)
    raw = trimesh.load_scene(str(tmp_path / "mesh.glb"))
    assert raw.extents[1] == pytest.approx(6, rel=1e-2), "glTF is y-up: our z must be its y"


def test_a_mesh_without_colours_is_no_metal(tmp_path: Path) -> None:
    """glTF's material for what has none is a metal, which programs show black where nothing surrounds it."""
    sphere = sphere_mesh(1)
    materials = {}
    for name, colours in (("plain", None), ("coloured", np.full((len(sphere.vertices), 3), 0.5, np.float32))):
        TriangleMesh(sphere.vertices, sphere.faces, sphere.vertex_normals, colours).save_glb(tmp_path / "mesh.glb")
        raw = (tmp_path / "mesh.glb").read_bytes()
        document = json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])
        (primitive,) = document["meshes"][0]["primitives"]
        assert ("COLOR_0" in primitive["attributes"]) == (name == "coloured")
        materials[name] = document.get("materials", [])[primitive.get("material", 0) :][:1]
    assert materials["plain"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0


def test_broken_meshes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="empty"):
        TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)))
    with pytest.raises(UserError, match="NaN"):
        TriangleMesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), np.zeros((3, 3)))
    with pytest.raises(UserError, match="vertices it does not have"):
        TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 3]]), np.zeros((3, 3)))
    (tmp_path / "mesh.glb").write_bytes(b"glTF but not really")
    with pytest.raises(UserError, match="not a readable GLB"):
        TriangleMesh.load_glb(tmp_path / "mesh.glb")


def test_a_part_of_an_obj_without_whole_faces_does_not_spoil_the_others(tmp_path: Path) -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 \nvn 0 0 1\n"
    (tmp_path / "mesh.obj").write_text(f"{corners}f 1/1/0\nusemtl paint\nf 2/1/1 3/2/1 4//1\nf 1/1/1 4/2/1 3//1\n")
    assert len(TriangleMesh.load(tmp_path / "mesh.obj").faces) == 2


def test_pictures_on_a_mesh_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shape is all that is wanted: what a texture unpacks to must cost neither time nor memory."""
    made = Gltf()
    look = {"pbrMetallicRoughness": {"baseColorTexture": made.texture(png((9, 99, 200)))}}
    made.mesh(material=look, TEXCOORD_0=UV)
    made.json["scenes"] = [{"nodes": [0]}]
    opened: list[object] = []
    monkeypatch.setattr(Image, "open", lambda *given, **named: opened.append(given))
    assert len(TriangleMesh.load(made.glb(tmp_path / "mesh.glb")).faces) == len(FACES)
    assert not opened
    with pytest.MonkeyPatch.context() as patch:  # guard: the library would
        loads = trimesh.load_scene
        patch.setattr(trimesh, "load_scene", lambda *given, **named: loads(*given, **named | {"skip_materials": False}))
        TriangleMesh.load(tmp_path / "mesh.glb")
    assert opened
