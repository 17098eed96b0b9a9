"""OBJ with its material libraries, and PLY in all its encodings."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.materials import Material, Parts
from illuminerf.cues.object_files import ObjectReading, UpAxis, load_object, load_object_in_place
from illuminerf.cues.raw_objects import ReadingLimits
from illuminerf.scene.images import linear_from_srgb
from tests.cues.made_objects import FACES, TETRAHEDRON, png

PLAIN = "v 0 0 0\nv 1 0 0\nv 0 5 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
UVS = "vt 0 0\nvt 1 0\nvt 0 1\n"


def load(path: Path, up_axis: UpAxis = "auto", limits: ReadingLimits | None = None) -> Parts:
    return load_object(path, np.random.default_rng(0), ObjectReading(up_axis, limits or ReadingLimits()))


def reason(path: Path, limits: ReadingLimits | None = None) -> str:
    with pytest.raises(BrokenObject) as caught:
        load(path, limits=limits)
    return caught.value.reason


def obj(folder: Path, text: str, library: str | None = None) -> Path:
    if library is not None:
        (folder / "a.mtl").write_text(library)
        text = "mtllib a.mtl\nusemtl stuff\n" + text
    (folder / "a.obj").write_text(text)
    return folder / "a.obj"


def material_of(folder: Path, library: str) -> Material:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + UVS + "f 1/1 2/2 3/3\n"
    return load(obj(folder, text, "newmtl stuff\n" + library))[0][1]


def test_obj_is_y_up_unless_told(tmp_path: Path) -> None:
    path = obj(tmp_path, PLAIN)
    for axis, tallest in (("auto", 2), ("y", 2), ("z", 1)):
        ((mesh, _),) = load(path, axis)  # type: ignore[arg-type]
        assert np.ptp(mesh.vertices, axis=0).argmax() == tallest
        assert len(mesh.faces) == 4 and np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-6)


def test_in_place_nothing_moves(tmp_path: Path) -> None:
    path = obj(tmp_path, PLAIN.replace("v 0 0 1", "v 30 40 1"))
    ((mesh, _),) = load_object_in_place(path, np.random.default_rng(0))
    wanted = {(0, 0, 0), (1, 0, 0), (0, 5, 0), (30, 40, 1)}
    assert {tuple(np.round(vertex, 3) + 0.0) for vertex in mesh.vertices.tolist()} == wanted
    ((moved, _),) = load(path, "z")
    assert np.abs(moved.vertices).max() <= 1


def test_one_picture_may_hold_roughness_and_metalness(tmp_path: Path) -> None:
    (tmp_path / "ks.png").write_bytes(png((10, 102, 204)))
    packed = material_of(tmp_path, "bsdf pbr\nKd 1 1 1\nmap_Ks ks.png\n")
    np.testing.assert_allclose(np.asarray(packed.roughness), 102 / 255, atol=1e-3)
    np.testing.assert_allclose(np.asarray(packed.metallic), 204 / 255, atol=1e-3)
    specular = material_of(tmp_path, "Kd 1 1 1\nmap_Ks ks.png\n")
    assert not specular.is_textured, "elsewhere map_Ks is a specular colour"


def test_ply_is_z_up_unless_told(tmp_path: Path) -> None:
    trimesh.Trimesh(TETRAHEDRON * [1, 5, 1], FACES).export(tmp_path / "a.ply")
    for axis, tallest in (("auto", 1), ("z", 1), ("y", 2)):
        ((mesh, _),) = load(tmp_path / "a.ply", axis)  # type: ignore[arg-type]
        assert np.ptp(mesh.vertices, axis=0).argmax() == tallest


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3 4\n",
        "f -4 -3 -2 -1\n",
        "f 1/1 2/2 3/3 4/1\n",
        "f 1//1 2//1 3//1 4//1\n",
        "f 1/1/1 2/2/1 3/3/1 4/1/1\n",
        "f 1 2 \\\n3 4\n",
    ],
)
def test_obj_polygons_of_every_spelling(tmp_path: Path, faces: str) -> None:
    square = "# a square\r\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\no name\ng group\ns 1\n"
    ((mesh, _),) = load(obj(tmp_path, square + UVS + faces), "z")
    assert len(mesh.faces) == 2
    np.testing.assert_allclose(mesh.vertex_normals, np.tile([0, 0, 1], (len(mesh.vertices), 1)), atol=1e-6)
    assert np.abs(
        np.cross(*(mesh.vertices[mesh.faces][:, i] - mesh.vertices[mesh.faces][:, 0] for i in (1, 2)))
    ).sum() == pytest.approx(4, rel=1e-5)


def test_obj_materials_are_kept_apart(tmp_path: Path) -> None:
    library = "newmtl red wood\nKd 0.5 0 0\nNs 98\nKs 1 1 1\nillum 2\nnewmtl blue\nKd 0 0 0.5\nillum 1\n"
    (tmp_path / "a.mtl").write_text(library)
    text = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    text += "usemtl red wood\nf 1 2 3\nusemtl blue\nf 1 3 4\nusemtl red wood\nf 1 4 2\n"
    red, blue = load(obj(tmp_path, text))
    assert (len(red[0].faces), len(blue[0].faces)) == (2, 1)
    np.testing.assert_allclose(red[1].base_color, [0.5, 0, 0])
    np.testing.assert_allclose(blue[1].base_color, [0, 0, 0.5])
    assert red[1].roughness == pytest.approx((2 / 100) ** 0.25) and blue[1].roughness == 1
    assert red[1].metallic == blue[1].metallic == 0


def test_obj_textures(tmp_path: Path) -> None:
    (tmp_path / "my wood.png").write_bytes(png((188, 255, 0)))
    wood = material_of(tmp_path, "Kd 0.5 1 1\nmap_Kd -s 1 1 1 -bm 2 my wood.png\n")
    np.testing.assert_allclose(np.asarray(wood.base_color)[0, 0], [0.25, 1, 0], atol=2e-3)
    np.testing.assert_allclose(np.unique(wood.uv, axis=0), [[0, 0], [0, 1], [1, 0]])
    # a black factor beside a picture, and a path of the exporter's machine
    wood = material_of(tmp_path, "Kd 0 0 0\nmap_Kd C:\\\\art\\\\my wood.png\n".replace("\\\\", "\\"))
    np.testing.assert_allclose(np.asarray(wood.base_color)[0, 0], [0.5, 1, 0], atol=5e-3)


def test_obj_physically_based_extension_and_normals(tmp_path: Path) -> None:
    (tmp_path / "rough.png").write_bytes(png((51, 51, 51)))
    (tmp_path / "normal.png").write_bytes(png((128, 128, 255)))
    (tmp_path / "height.png").write_bytes(png((128, 128, 128)))
    made = material_of(tmp_path, "Kd 0.2 0.2 0.2\nPr 0.9\nmap_Pr rough.png\nPm 0.75\nnorm normal.png\n")
    np.testing.assert_allclose(made.roughness, 0.2, atol=1e-3)
    np.testing.assert_allclose(made.metallic, 0.75)
    assert made.normal_map is not None
    np.testing.assert_allclose(made.normal_map[0, 0], [0, 0, 1], atol=1e-6)
    assert material_of(tmp_path, "Kd 0.2 0.2 0.2\nmap_Bump -bm 1 normal.png\n").normal_map is not None
    assert material_of(tmp_path, "Kd 0.2 0.2 0.2\nmap_Bump height.png\n").normal_map is None


@pytest.mark.parametrize(("line", "is_clear"), [("d 0.5", True), ("Tr 0.5", True), ("d 1", False), ("Tr 0", False)])
def test_obj_transparency(tmp_path: Path, line: str, is_clear: bool) -> None:
    library = f"newmtl stuff\nKd 0.5 0.5 0.5\n{line}\n"
    path = obj(tmp_path, PLAIN, library)
    assert reason(path) == "transparent" if is_clear else load(path)


def test_obj_opacity_maps(tmp_path: Path) -> None:
    for value, is_clear in ((255, False), (100, True)):
        Image.new("L", (4, 4), value).save(tmp_path / "hole.png")
        path = obj(tmp_path, PLAIN + UVS, "newmtl stuff\nKd 1 0 0\nmap_d hole.png\n")
        assert reason(path) == "transparent" if is_clear else load(path)


def test_obj_vertex_colours_are_srgb(tmp_path: Path) -> None:
    text = "v 0 0 0 0.5 0 1\nv 1 0 0 0.5 0 1\nv 0 1 0 0.5 0 1\nf 1 2 3\n"
    ((_, material),) = load(obj(tmp_path, text))
    np.testing.assert_allclose(np.asarray(material.base_color).reshape(-1, 3)[0], [0.214, 0, 1], atol=1e-3)


def test_broken_obj(tmp_path: Path) -> None:
    assert reason(obj(tmp_path, "v 0 0 0\nv 1 0 0\n")) == "empty"
    assert reason(obj(tmp_path, "")) == "empty"
    assert reason(obj(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")) == "unreadable"
    assert reason(obj(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -9\n")) == "unreadable"
    assert reason(obj(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/4 2/4 3/4\n")) == "unreadable"
    assert reason(obj(tmp_path, "v 0 zero 0\n")) == "unreadable"
    assert reason(obj(tmp_path, "v 0 0\n")) == "unreadable"
    assert reason(obj(tmp_path, "v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")) == "not finite"
    assert reason(obj(tmp_path, "v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n")) == "degenerate"
    assert reason(obj(tmp_path, PLAIN), ReadingLimits(max_faces=3)) == "too large"
    assert reason(obj(tmp_path, "mtllib absent.mtl\n" + PLAIN)) == "missing texture"
    assert reason(obj(tmp_path, PLAIN, "newmtl stuff\nmap_Kd absent.png\n")) == "missing texture"
    assert reason(obj(tmp_path, PLAIN, "newmtl stuff\nmap_Kd ../../absent.png\n")) == "unreadable"
    assert reason(obj(tmp_path, "mtllib ../a.mtl\n" + PLAIN)) == "unreadable"
    (tmp_path / "a.obj").write_bytes(np.random.default_rng(0).bytes(1000))
    assert reason(tmp_path / "a.obj") == "empty"


def colored() -> trimesh.Trimesh:
    colors = np.array([[188, 0, 0, 255], [0, 188, 0, 255], [0, 0, 188, 255], [255, 255, 255, 255]], np.uint8)
    return trimesh.Trimesh(TETRAHEDRON, FACES, vertex_colors=colors, process=False)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_vertex_colours(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "a.ply").write_bytes(colored().export(file_type="ply", encoding=encoding))
    ((mesh, material),) = load(tmp_path / "a.ply")
    assert len(mesh.faces) == 4
    found = np.unique(np.round(np.asarray(material.base_color), 2), axis=0)
    np.testing.assert_allclose(found, [[0, 0, 0.5], [0, 0.5, 0], [0.5, 0, 0], [1, 1, 1]], atol=6e-3)
    assert 0.02 <= material.roughness <= 0.5  # no material: a glossy lobe


def test_ply_big_endian_polygons_of_several_sizes(tmp_path: Path) -> None:
    header = (
        "ply\nformat binary_big_endian 1.0\ncomment made by hand\nelement vertex 5\nproperty double x\n"
        "property double y\nproperty double z\nproperty float quality\nelement face 2\n"
        "property list uchar int vertex_indices\nproperty uchar flags\nend_header\n"
    )
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)]
    body = b"".join(struct.pack(">dddf", *point, 0.5) for point in points)
    body += struct.pack(">B4iB", 4, 0, 1, 2, 3, 7) + struct.pack(">B3iB", 3, 1, 4, 2, 7)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    ((mesh, _),) = load(tmp_path / "a.ply")
    assert len(mesh.faces) == 3
    text = header.replace("binary_big_endian", "ascii") + "\n".join(f"{x} {y} {z} 0.5" for x, y, z in points)
    (tmp_path / "b.ply").write_text(text + "\n4 0 1 2 3 7\n3 1 4 2 7\n")
    ((same, _),) = load(tmp_path / "b.ply")
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], same.vertices[same.faces])


def test_ply_textures_per_corner(tmp_path: Path) -> None:
    (tmp_path / "wood.png").write_bytes(png((188, 0, 0)))
    text = (
        "ply\nformat ascii 1.0\ncomment TextureFile wood.png\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
        "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 0 0 1 0 0 1\n"
    )
    (tmp_path / "a.ply").write_text(text)
    ((_, material),) = load(tmp_path / "a.ply")
    assert material.is_textured
    np.testing.assert_allclose(np.asarray(material.base_color)[0, 0], [0.5, 0, 0], atol=5e-3)
    np.testing.assert_allclose(material.uv, [[0, 0], [1, 0], [0, 1]])
    (tmp_path / "wood.png").unlink()
    assert reason(tmp_path / "a.ply") == "missing texture"


def test_broken_ply(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    trimesh.PointCloud(np.random.default_rng(0).random((50, 3))).export(path)
    assert reason(path) == "empty"
    for encoding in ("ascii", "binary"):
        whole = colored().export(file_type="ply", encoding=encoding)
        for length in (2, 30, len(whole) // 2, len(whole) - 6):
            path.write_bytes(whole[:length])
            assert reason(path) == "unreadable"
        path.write_bytes(whole.replace(b"element vertex 4", b"element vertex 999999999"))
        assert reason(path) == "unreadable"
        path.write_bytes(whole.replace(b"element face 4", b"element face 999999999"))
        assert reason(path) == "too large"
    text = colored().export(file_type="ply", encoding="ascii").decode()
    path.write_text(text.replace("3 0 2 1", "3 0 2 9"))
    assert reason(path) == "unreadable"
    path.write_text(text.replace("0.00000000 0.00000000 0.00000000", "nan 0 0"))
    assert reason(path) == "not finite"
    ghost = colored()
    ghost.visual.vertex_colors[:, 3] = 100
    ghost.export(path)
    assert reason(path) == "transparent"


def test_colours_of_ply_are_not_linear() -> None:
    """Guards the tolerance above: read as linear, 188 would be 0.74."""
    assert abs(188 / 255 - float(linear_from_srgb(np.float32([188 / 255]))[0])) > 0.2
