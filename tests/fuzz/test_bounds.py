"""Files of a few bytes that promise gigabytes: refused by their word, before memory is spent."""

import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from illuminerf.cues.object_files import load_object
from illuminerf.data.capture import load_capture, write_capture
from illuminerf.data.decoding import read_straight
from illuminerf.fields.storage import load_field
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_exr, read_png_bytes, write_exr
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.checkpoint import load_checkpoint
from illuminerf.workflow.errors import UserError
from tests.cues.made_objects import Gltf
from tests.data.synthetic_capture import ball_cameras, ball_images
from tests.viewer.conftest import save_sphere

_MEGABYTES = 64


def png_bomb(path: Path) -> Path:
    header = struct.pack(">IIBBBBB", 65_000, 65_000, 8, 6, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(10_000))), (b"IEND", b""))
    parts = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


def jpeg_bomb(path: Path) -> Path:
    frame = struct.pack(">BHHB", 8, 65_000, 65_000, 1) + b"\1\x11\0"
    path.write_bytes(b"\xff\xd8\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9")
    return path


def exr_bomb(path: Path) -> Path:
    write_exr(path, dict.fromkeys("RGB", np.ones((8, 16), np.float32)))
    small, large = struct.pack("<4i", 0, 0, 15, 7), struct.pack("<4i", 0, 0, 64_999, 64_999)
    content = path.read_bytes()
    assert content.count(small) == 2, "data window and display window"
    path.write_bytes(content.replace(small, large))
    return path


def hdr_bomb(path: Path) -> Path:
    path.write_bytes(b"#?RADIANCE\n\n-Y 8000 +X 16000\n" + b"\2\2\x3e\x80" + b"\xff\0" * 2000)
    return path


def glb_bomb(path: Path) -> Path:
    made = Gltf().mesh()
    made.json["scenes"] = [{"nodes": [0]}]
    for accessor in made.json["accessors"]:
        del accessor["bufferView"]  # zeros, says the standard
        accessor["count"] = 3 * 10**9
    return made.glb(path)


def ply_bomb(path: Path) -> Path:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 3000000000\nproperty float x\nproperty float y\n"
    head += "property float z\nelement face 1000000000\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(head.encode() + bytes(100))
    return path


def tensor_bomb(path: Path) -> Path:
    header = json.dumps({"a": {"dtype": "F32", "shape": [10**6, 10**6], "data_offsets": [0, 4 * 10**12]}}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(16))
    return path


def header_bomb(path: Path) -> Path:
    path.write_bytes(struct.pack("<Q", 2**62) + b"{}")
    return path


def field_bomb(path: Path) -> Path:
    save_sphere(path, 0, None)
    load_field(path)  # good to begin with; what torch imports at the first use is not the bomb's
    content = json.loads((path / "field.json").read_text())
    content["field"]["surface"]["hidden_width"] = 10**9
    (path / "field.json").write_text(json.dumps(content))
    return path


def empty_capture_bomb(path: Path) -> Path:
    content = json.loads((capture_bomb(path) / "cameras.json").read_text())
    (path / "cameras.json").write_text(json.dumps(content | {"frames": [], "height": 2**63}))
    return path


def capture_bomb(path: Path) -> Path:
    cameras = ball_cameras(4, 10, 12)
    images = [image.astype(np.float32) / 255 for image in ball_images(cameras)]
    write_capture(path, images, cameras, list("abcd"), 1.0, np.zeros(3), "masked")
    content = json.loads((path / "cameras.json").read_text())
    (path / "cameras.json").write_text(json.dumps(content | {"height": 10**6, "width": 10**6}))
    return path


BOMBS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], object]]] = {
    "photograph.png": (png_bomb, read_straight),
    "sample.png": (png_bomb, read_png_bytes),
    "photograph.jpg": (jpeg_bomb, read_straight),
    "light.jpg": (jpeg_bomb, EnvironmentMap.load),
    "photograph.exr": (exr_bomb, read_straight),
    "cues.exr": (exr_bomb, read_exr),
    "light.exr": (exr_bomb, EnvironmentMap.load),
    "light.hdr": (hdr_bomb, EnvironmentMap.load),
    "object.glb": (glb_bomb, lambda path: load_object(path, np.random.default_rng(0))),
    "mesh.glb": (glb_bomb, TriangleMesh.load),
    "object.ply": (ply_bomb, lambda path: load_object(path, np.random.default_rng(0))),
    "mesh.ply": (ply_bomb, TriangleMesh.load),
    "tensors.safetensors": (tensor_bomb, load_checkpoint),
    "header.safetensors": (header_bomb, load_checkpoint),
    "field": (field_bomb, load_field),
    "capture": (capture_bomb, load_capture),
    "empty capture": (empty_capture_bomb, load_capture),
}


@pytest.mark.filterwarnings("ignore:.*low dynamic range")
@pytest.mark.parametrize("name", BOMBS)
def test_a_promise_of_gigabytes_is_refused(name: str, tmp_path: Path) -> None:
    write, read = BOMBS[name]
    path = write(tmp_path / name)
    tracemalloc.start()
    try:
        with pytest.raises(UserError):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < _MEGABYTES * 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "part", [("surface", "hidden_width"), ("proposal", "hidden_width"), ("appearance", "bottleneck_width")]
)
@pytest.mark.parametrize("width", [-8, -(2**63), 2**62, 10**30])
def test_impossible_widths_of_a_field_are_refused(part: tuple[str, str], width: int, tmp_path: Path) -> None:
    save_sphere(tmp_path, 0, None)
    assert load_field(tmp_path), "guard: it is good to begin with"
    content = json.loads((tmp_path / "field.json").read_text())
    content["field"][part[0]][part[1]] = width
    (tmp_path / "field.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="field.json"):
        load_field(tmp_path)
