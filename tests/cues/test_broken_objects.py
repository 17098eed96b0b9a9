"""Every kind of broken object is refused with its reason, quickly and without much memory."""

import errno
import io
import json
import os
import pickle
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from illuminerf.cues import object_files
from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.object_files import ObjectReading, load_object
from illuminerf.cues.raw_objects import ReadingLimits
from illuminerf.workflow.errors import UserError
from tests.cues.made_objects import FACES, TETRAHEDRON, UV, Gltf, png


def reason(path: Path, limits: ReadingLimits | None = None) -> tuple[str, str]:
    """Why `path` is refused, and the message."""
    with pytest.raises(BrokenObject) as caught:
        load_object(path, np.random.default_rng(0), ObjectReading(limits=limits or ReadingLimits()))
    assert isinstance(caught.value, UserError) and path.name in str(caught.value)
    return caught.value.reason, str(caught.value)


def is_kept(path: Path) -> bool:
    return bool(load_object(path, np.random.default_rng(0)))


def textured(image: bytes | str, alpha: float = 1.0, **material: Any) -> Gltf:
    gltf = Gltf()
    pbr = {"baseColorTexture": gltf.texture(image), "baseColorFactor": [1, 1, 1, alpha]}
    return gltf.mesh(material={"pbrMetallicRoughness": pbr, **material}, TEXCOORD_0=UV)


@pytest.mark.parametrize(
    ("alpha", "image_alpha", "material", "is_clear"),
    [
        (0.3, 255, {"alphaMode": "BLEND"}, True),
        (1.0, 255, {"alphaMode": "BLEND"}, False),
        (1.0, 251, {"alphaMode": "BLEND"}, False),
        (1.0, 249, {"alphaMode": "BLEND"}, True),
        (0.3, 10, {"alphaMode": "OPAQUE"}, False),
        (1.0, 200, {"alphaMode": "MASK"}, False),
        (1.0, 100, {"alphaMode": "MASK"}, True),
        (0.6, 200, {"alphaMode": "MASK"}, True),
        (1.0, 100, {"alphaMode": "MASK", "alphaCutoff": 0.2}, False),
        (1.0, 255, {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.5}}}, True),
        (1.0, 255, {"extensions": {"KHR_materials_transmission": {}}}, False),
    ],
)
def test_transparency(tmp_path: Path, alpha: float, image_alpha: int, material: dict[str, Any], is_clear: bool) -> None:
    path = textured(png((200, 100, 50, image_alpha)), alpha, **material).glb(tmp_path / "a.glb")
    assert reason(path)[0] == "transparent" if is_clear else is_kept(path)


def test_vertex_alpha_counts_where_it_blends(tmp_path: Path) -> None:
    colors = np.float32([[1, 0, 0, 0.5]] * 4)
    for mode, is_clear in (("BLEND", True), ("OPAQUE", False)):
        path = Gltf().mesh(material={"alphaMode": mode}, COLOR_0=colors).glb(tmp_path / "a.glb")
        assert reason(path)[0] == "transparent" if is_clear else is_kept(path)


def no_nodes(gltf: Gltf) -> None:
    gltf.json["scenes"] = [{"nodes": []}]


def as_points(gltf: Gltf) -> None:
    gltf.json["meshes"][0]["primitives"][0]["mode"] = 0


def no_meshes(gltf: Gltf) -> None:
    del gltf.json["nodes"][0]["mesh"]


@pytest.mark.parametrize("emptied", [no_nodes, as_points, no_meshes])
def test_empty(tmp_path: Path, emptied: Callable[[Gltf], None]) -> None:
    gltf = Gltf().mesh()
    emptied(gltf)
    assert reason(gltf.glb(tmp_path / "a.glb"))[0] == "empty"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite(tmp_path: Path, value: float) -> None:
    vertices = TETRAHEDRON.copy()
    vertices[2, 1] = value
    assert reason(Gltf().mesh(vertices).glb(tmp_path / "a.glb"))[0] == "not finite"
    assert is_kept(Gltf().mesh(vertices, FACES[1:2]).glb(tmp_path / "b.glb"))  # no face has that vertex
    node = {"translation": [value, 0, 0]}
    assert reason(Gltf().mesh(node=node).glb(tmp_path / "c.glb"))[0] == "not finite"


@pytest.mark.parametrize(
    "vertices",
    [np.ones((4, 3)), np.arange(12.0).reshape(4, 3), np.float32([[0, 0, 0], [1, 0, 0], [0, 1e-9, 0], [0, 0, 1e-9]])],
    ids=["point", "line", "needle"],
)
def test_degenerate(tmp_path: Path, vertices: np.ndarray) -> None:
    assert reason(Gltf().mesh(vertices).glb(tmp_path / "a.glb"))[0] == "degenerate"


def test_some_faces_without_area_are_dropped(tmp_path: Path) -> None:
    faces = np.concatenate([FACES, [[0, 0, 1], [2, 2, 2]]])
    ((mesh, _),) = load_object(Gltf().mesh(faces=faces).glb(tmp_path / "a.glb"), np.random.default_rng(0))
    assert len(mesh.faces) == len(FACES)


def absent_vertices(gltf: Gltf) -> None:
    gltf.json["meshes"][0]["primitives"][0]["indices"] = gltf.accessor(np.array([0, 1, 99], np.uint32))


def endless_claim(gltf: Gltf) -> None:
    gltf.json["accessors"][0]["count"] = 5_000_000  # of float32 [4, 3]


def outside_buffer(gltf: Gltf) -> None:
    gltf.json["bufferViews"][0]["byteLength"] = 10**12


def negative_offset(gltf: Gltf) -> None:
    gltf.json["accessors"][0]["byteOffset"] = -8


def own_ancestor(gltf: Gltf) -> None:
    gltf.json["nodes"] += [{"children": [1, 0]}]
    gltf.json["scenes"] = [{"nodes": [1]}]


def draco(gltf: Gltf) -> None:
    gltf.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]


def draco_unannounced(gltf: Gltf) -> None:
    gltf.json["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}


def old_version(gltf: Gltf) -> None:
    gltf.json["asset"] = {"version": "1.0"}


def mistyped(gltf: Gltf) -> None:
    gltf.json["nodes"][0]["rotation"] = "north"


def absent_accessor(gltf: Gltf) -> None:
    gltf.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 77


def short_normals(gltf: Gltf) -> None:
    gltf.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = gltf.accessor(TETRAHEDRON[:2])


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (absent_vertices, "vertex 99 of 4"),
        (endless_claim, "5,000,000 elements"),
        (outside_buffer, "buffer view"),
        (negative_offset, "claims"),
        (own_ancestor, "ancestors"),
        (draco, "KHR_draco_mesh_compression"),
        (draco_unannounced, "KHR_draco_mesh_compression"),
        (old_version, "version 1.0"),
        (mistyped, "transform"),
        (absent_accessor, "accessors"),
        (short_normals, "2 normals for 4"),
    ],
)
def test_contradictions_are_unreadable(tmp_path: Path, broken: Callable[[Gltf], None], said: str) -> None:
    gltf = Gltf().mesh()
    broken(gltf)
    found, message = reason(gltf.glb(tmp_path / "a.glb"))
    assert found == "unreadable" and said in message


def test_cut_files_and_noise_are_unreadable(tmp_path: Path) -> None:
    whole = textured(png((1, 2, 3))).glb(tmp_path / "a.glb").read_bytes()
    for length in (0, 3, 11, 19, 60, 200, len(whole) // 2, len(whole) - 5):
        (tmp_path / "a.glb").write_bytes(whole[:length])
        assert reason(tmp_path / "a.glb")[0] == "unreadable"
    generator = np.random.default_rng(0)
    for name in ("a.glb", "a.gltf", "a.ply"):
        (tmp_path / name).write_bytes(generator.bytes(500))
        assert reason(tmp_path / name)[0] == "unreadable"
    (tmp_path / "a.fbx").write_bytes(whole)
    assert reason(tmp_path / "a.fbx")[0] == "unreadable"


def machine_trouble(path: Path) -> str:
    """The error of a file that cannot be read, which says nothing about the object."""
    with pytest.raises(UserError) as caught:
        load_object(path, np.random.default_rng(0))
    assert not isinstance(caught.value, BrokenObject) and caught.value.got and caught.value.fix
    return str(caught.value)


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nmtllib a.mtl\nusemtl stuff\nf 1/1 2/2 3/3\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj", ".ply"])
@pytest.mark.parametrize("code", [errno.EIO, errno.ESTALE, errno.EACCES])
def test_a_disk_that_fails_is_no_fault_of_the_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, code: int
) -> None:
    path = tmp_path / f"a{suffix}"
    assert "a" + suffix in machine_trouble(path)  # absent
    (tmp_path / "a.mtl").write_text("newmtl stuff\nKd 1 0 0\n")
    whole = {".obj": OBJ.encode(), ".ply": PLY.encode()}.get(suffix) or Gltf().mesh().glb(tmp_path / "b").read_bytes()
    path.write_bytes(whole)
    assert is_kept(path)

    opened = io.open

    def failing(file: Any, *arguments: Any, **options: Any) -> Any:
        if str(file) == str(path):
            raise OSError(code, os.strerror(code), str(path))
        return opened(file, *arguments, **options)

    monkeypatch.setattr(io, "open", failing)
    monkeypatch.setattr("builtins.open", failing)
    assert os.strerror(code) in machine_trouble(path)


def test_side_files_that_fail_are_no_fault_but_missing_ones_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.obj").write_text(OBJ)
    assert reason(tmp_path / "a.obj")[0] == "missing texture"
    (tmp_path / "a.obj").write_text(OBJ.replace("a.mtl", "m" * 5000))
    assert reason(tmp_path / "a.obj")[0] == "unreadable"
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text("newmtl stuff\nmap_Kd a.png\n")
    assert reason(tmp_path / "a.obj")[0] == "missing texture"
    (tmp_path / "a.png").write_bytes(png((1, 2, 3)))
    assert is_kept(tmp_path / "a.obj")
    read = Path.read_bytes

    def failing(path: Path) -> bytes:
        if path.name == "a.png":
            raise OSError(errno.EIO, "Input/output error")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", failing)
    assert "Input/output" in machine_trouble(tmp_path / "a.obj")


def test_too_little_memory_is_no_fault_of_the_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def too_much(*_: Any) -> None:
        raise MemoryError

    path = Gltf().mesh().glb(tmp_path / "a.glb")
    for name in ("read_gltf", "normalized"):
        with monkeypatch.context() as patched:
            patched.setattr(object_files, name, too_much)
            with pytest.raises(MemoryError):
                load_object(path, np.random.default_rng(0))


@pytest.mark.parametrize(
    "line", ["Pr nan", "Pm inf", "d nan", "Kd nan 0 0", "illum nan", "Tr -inf", "map_Bump -bm nan n.png", "Pr rough"]
)
def test_numbers_of_materials_must_be_finite(tmp_path: Path, line: str) -> None:
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "n.png").write_bytes(png((128, 128, 255)))
    (tmp_path / "a.mtl").write_text(f"newmtl stuff\nKd 0.5 0.5 0.5\n{line}\n")
    with pytest.raises(BrokenObject, match=r"a\.mtl has a broken material 'stuff'") as caught:
        load_object(tmp_path / "a.obj", np.random.default_rng(0))
    assert caught.value.reason == "unreadable"
    finite = line.replace("nan", "1").replace("-inf", "0").replace("inf", "1").replace("rough", "0.5")
    (tmp_path / "a.mtl").write_text(f"newmtl stuff\nKd 0.5 0.5 0.5\n{finite}\n")
    assert is_kept(tmp_path / "a.obj")


def test_numbers_of_gltf_that_are_not_finite_count_as_left_out(tmp_path: Path) -> None:
    gltf = Gltf()
    normal = gltf.texture(png((160, 128, 220))) | {"scale": float("nan")}
    pbr = {"baseColorFactor": [float("nan"), 0.5, 0.5, float("nan")], "roughnessFactor": float("inf")}
    gltf.mesh(material={"pbrMetallicRoughness": pbr, "normalTexture": normal}, TEXCOORD_0=UV)
    ((_, material),) = load_object(gltf.glb(tmp_path / "a.glb"), np.random.default_rng(0))
    assert material.normal_map is not None and np.isfinite(material.normal_map).all()
    assert np.asarray(material.base_color)[0, 0].tolist() == [1.0, 0.5, 0.5] and np.max(material.roughness) == 1


@pytest.mark.parametrize(
    "error", [UserError("a material's roughness is out of range"), ValueError("x"), ZeroDivisionError(), IndexError(),
              struct.error("x"), BrokenObject("too large", "a.glb is too large")]
)  # fmt: skip
@pytest.mark.parametrize("step", ["normalized", "merged_by_material", "_finished"])
def test_trouble_after_reading_leaves_the_object_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, step: str
) -> None:
    def fails(*_: Any) -> None:
        raise error

    monkeypatch.setattr(object_files, step, fails)
    found, _ = reason(Gltf().mesh().glb(tmp_path / "a.glb"))
    assert found == ("too large" if isinstance(error, BrokenObject) else "unreadable")


def test_errors_survive_a_process_pool() -> None:
    error = BrokenObject("missing texture", "a.glb names a file", got="'x.png'", wanted="a file", fix="copy it")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is BrokenObject and str(again) == str(error)
    assert (again.reason, again.what, again.got, again.wanted, again.fix) == (
        "missing texture", "a.glb names a file", "'x.png'", "a file", "copy it",
    )  # fmt: skip


def test_bump_maps_are_decoded_like_other_textures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PostScript, which Pillow would have another program run, is never opened; a bluish picture is."""
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text("newmtl stuff\nmap_Kd a.png\nmap_Bump b.png\n")
    (tmp_path / "a.png").write_bytes(png((1, 2, 3)))
    (tmp_path / "b.png").write_bytes(png((128, 128, 255)))
    ((_, material),) = load_object(tmp_path / "a.obj", np.random.default_rng(0))
    assert material.normal_map is not None
    postscript = io.BytesIO()
    Image.new("RGB", (4, 4), (128, 128, 255)).save(postscript, "EPS")
    (tmp_path / "b.png").write_bytes(postscript.getvalue())
    monkeypatch.setattr("PIL.EpsImagePlugin.Ghostscript", lambda *_, **__: pytest.fail("Ghostscript was started"))
    assert Image.open(io.BytesIO(postscript.getvalue())).format == "EPS"
    ((_, material),) = load_object(tmp_path / "a.obj", np.random.default_rng(0))
    assert material.normal_map is None


def test_damaged_bytes_never_escape_as_other_errors(tmp_path: Path) -> None:
    """Single bytes changed at random: whatever happens, it is a mesh or a `BrokenObject`."""
    gltf = textured(png((1, 2, 3)), alphaMode="BLEND")
    gltf.json["nodes"][0] |= {"translation": [1, 2, 3], "rotation": [0, 0, 0, 1], "scale": [1, 2, 1]}
    whole = gltf.glb(tmp_path / "a.glb").read_bytes()
    generator = np.random.default_rng(0)
    num_refused = 0
    for _ in range(600):
        damaged = bytearray(whole)
        position = generator.integers(0, len(whole))
        # digits for digits, so that the JSON still parses and what it says is wrong
        is_digit = chr(damaged[position]).isdigit()
        damaged[position] = generator.integers(48, 58) if is_digit else generator.integers(32, 127)
        (tmp_path / "a.glb").write_bytes(damaged)
        try:
            load_object(tmp_path / "a.glb", np.random.default_rng(0))
        except BrokenObject:
            num_refused += 1
    assert 100 < num_refused < 500


def test_missing_files(tmp_path: Path) -> None:
    assert reason(textured("wood.png").gltf(tmp_path / "a.gltf"))[0] == "missing texture"
    gltf = textured(png((1, 2, 3))).gltf(tmp_path / "b.gltf")
    (tmp_path / "data.bin").unlink()
    assert reason(gltf)[0] == "missing texture"


@pytest.mark.parametrize("uri", ["../secret.png", "/etc/hostname", "a/../../secret.png", "%2e%2e/secret.png"])
def test_uris_may_not_leave_the_folder(tmp_path: Path, uri: str) -> None:
    (tmp_path / "secret.png").write_bytes(png((1, 2, 3)))
    inside = tmp_path / "inside"
    inside.mkdir()
    found, message = reason(textured(uri).gltf(inside / "a.gltf"))
    assert found == "unreadable" and "outside" in message
    (inside / "link.png").symlink_to(tmp_path / "secret.png")
    assert reason(textured("link.png").gltf(inside / "b.gltf"))[0] == "unreadable"
    assert "network" in reason(textured("https://example.com/a.png").gltf(inside / "c.gltf"))[1]


def test_corrupt_images(tmp_path: Path) -> None:
    whole = png((200, 100, 50), 64)
    for image in (b"not an image", whole[: len(whole) // 2], b"%!PS-Adobe-3.0 EPSF-3.0\n"):
        found, message = reason(textured(image).glb(tmp_path / "a.glb"))
        assert found == "unreadable" and "image 0" in message


def test_decompression_bombs_are_not_decoded(tmp_path: Path) -> None:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    for side in (12_000, 60_000):
        header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
        data = zlib.compress(b"\0" * 1000)
        bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
        path = textured(bomb).glb(tmp_path / "a.glb")
        tracemalloc.start()
        assert reason(path)[0] == "too large"
        assert tracemalloc.get_traced_memory()[1] < 20e6
        tracemalloc.stop()


def test_too_large_before_memory_is_spent(tmp_path: Path) -> None:
    path = Gltf().mesh().glb(tmp_path / "a.glb")
    assert reason(path, ReadingLimits(max_faces=3))[0] == "too large"
    assert reason(path, ReadingLimits(max_megabytes=1e-4))[0] == "too large"
    # a thousand instances of one small mesh
    gltf = Gltf().mesh()
    gltf.json["nodes"] *= 1000
    gltf.json["scenes"] = [{"nodes": list(range(1000))}]
    found, message = reason(gltf.glb(tmp_path / "b.glb"), ReadingLimits(max_faces=3999))
    assert found == "too large" and "4,000 faces" in message
    # accessors without data stand for zeros, so only the limit is in the way of 10^9 of them
    gltf = Gltf().mesh()
    gltf.json["accessors"][0] = {"componentType": 5126, "count": 10**9, "type": "VEC3"}
    gltf.json["accessors"][1] = {"componentType": 5125, "count": 3 * 10**9, "type": "SCALAR"}
    tracemalloc.start()
    assert reason(gltf.glb(tmp_path / "c.glb"))[0] == "too large"
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


def test_deep_json_is_unreadable(tmp_path: Path) -> None:
    (tmp_path / "a.gltf").write_text('{"asset":' + "[" * 100_000 + "]" * 100_000 + "}")
    assert reason(tmp_path / "a.gltf")[0] == "unreadable"
    (tmp_path / "b.gltf").write_text(json.dumps([1, 2]))
    assert reason(tmp_path / "b.gltf")[0] == "unreadable"


def test_sixteen_bit_images_are_read(tmp_path: Path) -> None:
    out = io.BytesIO()
    Image.fromarray(np.full((4, 4), 188 * 256, np.uint16)).save(out, "PNG")
    ((_, material),) = load_object(textured(out.getvalue()).glb(tmp_path / "a.glb"), np.random.default_rng(0))
    np.testing.assert_allclose(np.asarray(material.base_color)[0, 0], 0.503, atol=2e-3)
