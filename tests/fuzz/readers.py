"""Every reader of files from elsewhere, with good inputs to start from and the way they are spoilt."""

import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from illuminerf.cues.object_files import load_object
from illuminerf.data.capture import load_capture, write_capture
from illuminerf.data.decoding import read_straight
from illuminerf.data.object_collection import read_ids
from illuminerf.data.reading import read_source
from illuminerf.diffusion.relighting_model import RelightingModelConfig
from illuminerf.fields.storage import load_field
from illuminerf.scene.coloured_meshes import save_coloured_ply
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_exr, read_png_bytes, write_exr
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.scene.relighting_pairs import decode_item, encode_item
from illuminerf.stages import estimate_geometry, train_relighting_model
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.config import from_json, to_json
from illuminerf.workflow.shards import read_samples, sample_tar
from tests.cues.made_objects import FACES, TETRAHEDRON, UV, Gltf, png
from tests.data.synthetic_capture import ball_cameras, ball_images, write_plain, write_tensoir, write_transforms
from tests.fuzz.mutation import (
    mutated_bytes,
    mutated_glb,
    mutated_json,
    mutated_png,
    mutated_safetensors,
)
from tests.viewer.conftest import save_sphere

_CAMERAS = ball_cameras(4, 10, 12)
_IMAGES = ball_images(_CAMERAS)
Mutation = Callable[..., bytes]


@dataclass(frozen=True)
class Reader:
    """One reader, a folder for it, and the file in it that is spoilt."""

    name: str
    file: str
    """Name in the folder."""
    read: Callable[[Path], object]
    """Of the folder."""
    mutate: Mutation
    seeds: Callable[[Path], list[bytes]]
    """Good contents of the file; writes what else the folder needs."""


def _image(mode: str, kind: str, **options: Any) -> bytes:
    out = io.BytesIO()
    picture = Image.fromarray(_IMAGES[0])
    picture.convert(mode).save(out, kind, **options)
    return out.getvalue()


def _deep_png() -> bytes:
    """16 bits per channel, which Pillow does not write."""
    import zlib

    rows = b"".join(b"\2" + bytes(range(48)) for _ in range(6))
    parts = (struct.pack(">IIBBBBB", 8, 6, 16, 2, 0, 0, 0), zlib.compress(rows), b"")
    chunks = ((kind, body) for kind, body in zip((b"IHDR", b"IDAT", b"IEND"), parts, strict=True))
    framed = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def _pngs(_: Path) -> list[bytes]:
    exif = Image.Exif()
    exif[0x0112] = 6
    palette = _image("P", "PNG", transparency=0)
    return [_image("RGBA", "PNG"), _image("LA", "PNG"), palette, _deep_png(), _image("RGB", "PNG", exif=exif)]


def _jpegs(_: Path) -> list[bytes]:
    exif = Image.Exif()
    exif[0x0112] = 8
    return [_image("RGB", "JPEG", exif=exif), _image("L", "JPEG", quality=30), _image("RGB", "JPEG", progressive=True)]


def _exrs(folder: Path) -> list[bytes]:
    plane = np.linspace(0, 2, 8 * 16, dtype=np.float32).reshape(8, 16)
    found = []
    for names, half in (("RGB", True), ("RGBA", False), ("Y", True)):
        write_exr(folder / "seed.exr", dict.fromkeys(names, plane), half=half)
        found.append((folder / "seed.exr").read_bytes())
    return found


def _hdrs(_: Path) -> list[bytes]:
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n"
    line = b"\2\2\0\x10" + b"\x90\x40" * 3 + b"\x10" + bytes(range(120, 136))
    return [head + line * 8, head + bytes(range(128)) * 4]


def _glbs(folder: Path) -> list[bytes]:
    simple = Gltf().mesh()
    simple.json["scenes"] = [{"nodes": [0]}]
    plain = simple.glb(folder / "seed.glb").read_bytes()
    textured = Gltf()
    look = {"pbrMetallicRoughness": {"baseColorTexture": textured.texture(png((9, 99, 200))), "roughnessFactor": 0.4}}
    colours = np.full((4, 4), 200, np.uint8)
    textured.mesh(material=look, TEXCOORD_0=UV, COLOR_0=textured.accessor(colours, normalized=True))
    textured.mesh(faces=FACES[:2], node={"scale": [1, 2, 3], "rotation": [0, 0, 0.6, 0.8], "children": [0]})
    textured.json["scenes"] = [{"nodes": [1]}]
    return [plain, textured.glb(folder / "seed.glb").read_bytes()]


def _gltfs(folder: Path) -> list[bytes]:
    document = Gltf().mesh(TEXCOORD_0=UV)
    document.json["scenes"] = [{"nodes": [0]}]
    return [document.gltf(folder / "seed.gltf").read_bytes()]


def _objs(folder: Path) -> list[bytes]:
    (folder / "object.mtl").write_text("newmtl red\nKd 0.8 0.1 0.1\nNs 40\nmap_Kd red.png\n")
    (folder / "red.png").write_bytes(png((200, 10, 10)))
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in TETRAHEDRON.tolist())
    faces = "".join(f"f {a + 1}/1/1 {b + 1}/2/1 {c + 1}//1\n" for a, b, c in FACES.tolist())
    coloured = "".join(f"v {x} {y} {z} 0.1 0.2 0.3\n" for x, y, z in TETRAHEDRON.tolist()) + "f -4 -3 -2 -1\n"
    head = "mtllib object.mtl\n" + corners + "vt 0 0\nvt 1 0\nvn 0 0 1\nusemtl red\n"
    return [(head + faces).encode(), coloured.encode()]


def _mtls(folder: Path) -> list[bytes]:
    (folder / "object.obj").write_bytes(_objs(folder)[0])
    content = (
        b"newmtl red\nKd 0.8 0.1 0.1\nKs 1 1 1\nNs 40\nillum 2\nmap_Kd -s 1 1 1 red.png\nnorm -bm 2 red.png\nPr 0.3\n"
    )
    return [content, b"newmtl red\nbsdf pbr\nmap_Ks red.png\nd 1\n"]


def _plys(folder: Path) -> list[bytes]:
    head = b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += b"element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [*TETRAHEDRON.tolist(), *([3, *face] for face in FACES.tolist())]
    lines = "\n".join(" ".join(map("{:g}".format, row)) for row in rows).encode() + b"\n"
    mesh = sphere_mesh(0)
    coloured = TriangleMesh(mesh.vertices, mesh.faces, mesh.vertex_normals, np.abs(mesh.vertices))
    save_coloured_ply(folder / "seed.ply", coloured)
    return [head + lines, (folder / "seed.ply").read_bytes()]


def _tensors(folder: Path) -> list[bytes]:
    save_checkpoint(folder / "seed.safetensors", {"a": torch.ones(3, 2), "b": torch.zeros(2)}, {"step": 3})
    return [(folder / "seed.safetensors").read_bytes()]


def _fields(name: str) -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        save_sphere(folder, 0, torch.ones(2, 4))
        return [(folder / name).read_bytes()]

    return seeds


def _transforms(folder: Path) -> list[bytes]:
    write_transforms(folder, _CAMERAS, _IMAGES)
    plain = (folder / "transforms.json").read_bytes()
    content = json.loads(plain)
    for frame in content["frames"]:
        frame |= {"fl_x": 20.0, "fl_y": 21.0, "w": 12, "h": 10, "k1": 0.01, "mask_path": frame["file_path"]}
    more = {"camera_model": "OPENCV", "train_filenames": [frame["file_path"] for frame in content["frames"]]}
    angle = {"camera_angle_x": 0.7, "frames": json.loads(plain)["frames"]}
    applied = {"applied_transform": np.eye(4)[:3].tolist()}
    return [plain, json.dumps(content | more | applied).encode(), json.dumps(angle).encode()]


def _metadata(folder: Path) -> list[bytes]:
    write_tensoir(folder, _CAMERAS, _IMAGES)
    return [(folder / "train_000" / "metadata.json").read_bytes()]


def _plain_cameras(folder: Path) -> list[bytes]:
    write_plain(folder, _CAMERAS, _IMAGES)
    content = json.loads((folder / "cameras.json").read_bytes())
    for view, frame in enumerate(content["frames"]):
        frame |= {"image": f"images/{view}.png", "height": 10, "width": 12, "distortion": {"k1": 0.1}}
    return [(folder / "cameras.json").read_bytes(), json.dumps(content).encode()]


def _captures(name: str) -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        images = [image.astype(np.float32) / 255 for image in _IMAGES]
        write_capture(folder, images, _CAMERAS, ["a", "b", "c", "d"], 1.0, np.zeros(3), "masked")
        return [(folder / name).read_bytes()]

    return seeds


def _items(_: Path) -> list[bytes]:
    plane = np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4)
    fields = {"alpha": plane, "roughness": plane, "metallic": plane}
    shapes = {"targets": (2, 3, 4, 4), "cues": (2, 12, 4, 4), "base_color": (3, 4, 4), "normal": (3, 4, 4)}
    fields |= {name: np.broadcast_to(plane, shape) for name, shape in shapes.items()}
    return [sample_tar("a_0", encode_item(**fields, metadata={"object": "a"}))]


def _item_tensors(folder: Path) -> list[bytes]:
    ((_, files),) = read_samples(_items(folder)[0])
    return [files["safetensors"]]


def _read_items(folder: Path) -> None:
    for key, files in read_samples((folder / "shard.tar").read_bytes()):
        decode_item(files.get("safetensors", b""), key)


def _configs(config: Any) -> Callable[[Path], list[bytes]]:
    return lambda _: [json.dumps(to_json(config)).encode()]


def _generator() -> np.random.Generator:
    return np.random.default_rng(0)


READERS = {
    reader.name: reader
    for reader in (
        Reader("png", "a.png", lambda f: read_straight(f / "a.png"), mutated_png, _pngs),
        Reader("own png", "a.png", lambda f: read_png_bytes(f / "a.png"), mutated_png, _pngs),
        Reader("jpeg", "a.jpg", lambda f: read_straight(f / "a.jpg"), mutated_bytes, _jpegs),
        Reader("exr photograph", "a.exr", lambda f: read_straight(f / "a.exr"), mutated_bytes, _exrs),
        Reader("exr", "a.exr", lambda f: read_exr(f / "a.exr"), mutated_bytes, _exrs),
        Reader("exr light", "a.exr", lambda f: EnvironmentMap.load(f / "a.exr"), mutated_bytes, _exrs),
        Reader("hdr light", "a.hdr", lambda f: EnvironmentMap.load(f / "a.hdr"), mutated_bytes, _hdrs),
        Reader("glb", "a.glb", lambda f: load_object(f / "a.glb", _generator()), mutated_glb, _glbs),
        Reader("gltf", "a.gltf", lambda f: load_object(f / "a.gltf", _generator()), mutated_json, _gltfs),
        Reader("obj", "a.obj", lambda f: load_object(f / "a.obj", _generator()), mutated_bytes, _objs),
        Reader("mtl", "object.mtl", lambda f: load_object(f / "object.obj", _generator()), mutated_bytes, _mtls),
        Reader("ply", "a.ply", lambda f: load_object(f / "a.ply", _generator()), mutated_bytes, _plys),
        Reader("glb mesh", "a.glb", lambda f: TriangleMesh.load(f / "a.glb"), mutated_glb, _glbs),
        Reader("gltf mesh", "a.gltf", lambda f: TriangleMesh.load(f / "a.gltf"), mutated_json, _gltfs),
        Reader("obj mesh", "a.obj", lambda f: TriangleMesh.load(f / "a.obj"), mutated_bytes, _objs),
        Reader("ply mesh", "a.ply", lambda f: TriangleMesh.load(f / "a.ply"), mutated_bytes, _plys),
        Reader(
            "checkpoint", "a.safetensors", lambda f: load_checkpoint(f / "a.safetensors"), mutated_safetensors, _tensors
        ),
        Reader("field", "field.safetensors", load_field, mutated_safetensors, _fields("field.safetensors")),
        Reader("field.json", "field.json", load_field, mutated_json, _fields("field.json")),
        Reader("transforms.json", "transforms.json", read_source, mutated_json, _transforms),
        Reader("metadata.json", "train_000/metadata.json", read_source, mutated_json, _metadata),
        Reader("cameras.json", "cameras.json", read_source, mutated_json, _plain_cameras),
        Reader("capture cameras", "cameras.json", load_capture, mutated_json, _captures("cameras.json")),
        Reader("capture.json", "capture.json", load_capture, mutated_json, _captures("capture.json")),
        Reader("shard", "shard.tar", _read_items, mutated_bytes, _items),
        Reader(
            "training item",
            "a.safetensors",
            lambda f: decode_item((f / "a.safetensors").read_bytes()),
            mutated_safetensors,
            _item_tensors,
        ),
        Reader(
            "ids json",
            "a.json",
            lambda f: read_ids(f / "a.json"),
            mutated_json,
            lambda _: [b'["a1", "b2"]', b'{"a": 1}'],
        ),
        Reader("ids csv", "a.csv", lambda f: read_ids(f / "a.csv"), mutated_bytes, lambda _: [b"uid,n\na1,2\nb2,3\n"]),
        Reader(
            "geometry config",
            "a.json",
            lambda f: from_json(estimate_geometry.Config, read_json(f / "a.json")),
            mutated_json,
            _configs(estimate_geometry.Config()),
        ),
        Reader(
            "model config",
            "a.json",
            lambda f: from_json(RelightingModelConfig, read_json(f / "a.json")),
            mutated_json,
            _configs(RelightingModelConfig()),
        ),
        Reader(
            "training config",
            "a.json",
            lambda f: from_json(train_relighting_model.Config, read_json(f / "a.json")),
            mutated_json,
            _configs(train_relighting_model.Config()),
        ),
    )
}
