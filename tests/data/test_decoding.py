"""Pixels of every kind of file, against what was written."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from illuminerf.data.decoding import EXIF_ORIENTATION, image_size, read_straight
from illuminerf.data.deep_png import _unfiltered, read_deep_png
from illuminerf.scene.images import linear_from_srgb, write_exr
from illuminerf.workflow.errors import UserError

GENERATOR = np.random.default_rng(0)
RGBA = GENERATOR.integers(0, 256, (6, 9, 4), np.uint8)


def filtered_row(row: np.ndarray, above: np.ndarray, num_bytes: int, kind: int) -> bytes:
    """One row under a PNG filter, byte by byte as the specification words it."""
    out = bytearray([kind])
    for x in range(len(row)):
        a = int(row[x - num_bytes]) if x >= num_bytes else 0
        b = int(above[x])
        c = int(above[x - num_bytes]) if x >= num_bytes else 0
        p = a + b - c
        nearest = min(((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - c), 2, c)))[2]
        out.append((int(row[x]) - [0, a, b, (a + b) // 2, nearest][kind]) % 256)
    return bytes(out)


def write_png16(path: Path, values: np.ndarray, filters: list[int], colour: int, interlace: int = 0) -> None:
    height, width, channels = values.shape
    rows = values.astype(">u2").view(np.uint8).reshape(height, -1)
    above = np.zeros_like(rows[0])
    raw = b""
    for row, kind in zip(rows, filters, strict=True):
        raw += filtered_row(row, above, channels * 2, kind)
        above = row
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 16, colour, 0, 0, interlace)
    packed = zlib.compress(raw)
    parts = (body, b"IDAT" + packed[:20], b"IDAT" + packed[20:], b"IEND")
    chunks = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in parts)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


@pytest.mark.parametrize("suffix", [".png", ".webp", ".tiff"])
def test_eight_bit_rgba_is_exact(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"image{suffix}"
    Image.fromarray(RGBA).save(path, **({"lossless": True, "exact": True} if suffix == ".webp" else {}))
    np.testing.assert_array_equal(read_straight(path), RGBA.astype(np.float32) / 255)


def test_grey_grey_alpha_palette_and_bilevel(tmp_path: Path) -> None:
    grey, alpha = RGBA[..., 0], RGBA[..., 3]
    for mode, array in (("L", grey), ("LA", np.dstack([grey, alpha]))):
        Image.fromarray(array, mode).save(tmp_path / f"{mode}.png")
        pixels = np.round(read_straight(tmp_path / f"{mode}.png") * 255)
        np.testing.assert_array_equal(pixels[..., :3], grey[..., None].repeat(3, -1))
        np.testing.assert_array_equal(pixels[..., 3], alpha if mode == "LA" else 255)
    palette = Image.fromarray((grey % 2), "P")
    palette.putpalette([10, 20, 30, 200, 100, 50])
    palette.save(tmp_path / "P.png", transparency=0)
    pixels = np.round(read_straight(tmp_path / "P.png") * 255)
    np.testing.assert_array_equal(pixels[grey % 2 == 1], [[200, 100, 50, 255]] * int((grey % 2).sum()))
    assert (pixels[grey % 2 == 0][:, 3] == 0).all()
    Image.fromarray(grey > 127).save(tmp_path / "1.png")
    np.testing.assert_array_equal(read_straight(tmp_path / "1.png")[..., 0], grey > 127)


def test_sixteen_bit_grey(tmp_path: Path) -> None:
    values = GENERATOR.integers(0, 65536, (5, 4)).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "deep.png")
    np.testing.assert_allclose(read_straight(tmp_path / "deep.png")[..., 1], values / 65535, atol=1e-7)


@pytest.mark.parametrize(("colour", "channels"), [(2, 3), (4, 2), (6, 4)])
def test_sixteen_bit_colour_keeps_all_bits(tmp_path: Path, colour: int, channels: int) -> None:
    values = GENERATOR.integers(0, 65536, (7, 5, channels))
    write_png16(tmp_path / "deep.png", values, [0, 1, 2, 3, 4, 4, 3], colour)
    pixels = read_straight(tmp_path / "deep.png")
    wanted = values / 65535
    colours = wanted[..., :1].repeat(3, -1) if colour == 4 else wanted[..., :3]
    np.testing.assert_allclose(pixels[..., :3], colours, atol=1e-7)
    np.testing.assert_allclose(pixels[..., 3], 1 if colour == 2 else wanted[..., -1], atol=1e-7)
    with Image.open(tmp_path / "deep.png") as image:  # guard: eight bits would not pass
        assert np.abs(np.asarray(image.convert("RGBA"))[..., :3] / 255 - colours).max() > 1e-4


@given(seed=st.integers(0, 2**16), height=st.integers(1, 9), width=st.integers(1, 9))
@settings(max_examples=30, deadline=None)
def test_the_filters_are_undone_for_any_shape(seed: int, height: int, width: int) -> None:
    generator = np.random.default_rng(seed)
    rows = generator.integers(0, 256, (height, width * 6)).astype(np.uint8)
    filters = generator.integers(0, 5, height).astype(np.uint8)
    above = np.zeros_like(rows[0])
    filtered = []
    for row, kind in zip(rows, filters, strict=True):
        filtered.append(np.frombuffer(filtered_row(row, above, 6, int(kind))[1:], np.uint8))
        above = row
    undone = _unfiltered(filters, np.stack(filtered).reshape(height, width, 6))
    np.testing.assert_array_equal(undone.reshape(height, -1), rows)


def test_spoilt_sixteen_bit_files(tmp_path: Path) -> None:
    values = GENERATOR.integers(0, 65536, (7, 5, 3))
    path = tmp_path / "deep.png"
    write_png16(path, values, [0] * 7, 2)
    path.write_bytes(path.read_bytes()[:80])
    with pytest.raises(UserError, match="cannot be read"):
        read_straight(path)
    write_png16(path, values, [0] * 7, 2, interlace=1)
    with pytest.raises(UserError, match="interlac"):
        read_straight(path)
    with pytest.raises(ValueError, match="filter"):
        _unfiltered(np.array([7], np.uint8), np.zeros((1, 1, 6), np.uint8))
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(ValueError, match="not a PNG"):
        read_deep_png(tmp_path / "text.png")


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_exif_orientation_stands_images_upright(tmp_path: Path, orientation: int, suffix: str) -> None:
    upright = np.zeros((24, 40, 3), np.uint8)
    upright[:8, :8] = [255, 0, 0]  # red top left, green top right: no two of the eight look alike
    upright[:8, -8:] = [0, 255, 0]
    stored = {
        1: upright, 2: upright[:, ::-1], 3: upright[::-1, ::-1], 4: upright[::-1], 5: upright.swapaxes(0, 1),
        6: np.rot90(upright, 1), 7: upright[::-1, ::-1].swapaxes(0, 1), 8: np.rot90(upright, -1),
    }[orientation]  # fmt: skip
    exif = Image.Exif()
    exif[EXIF_ORIENTATION] = orientation
    path = tmp_path / f"photo{suffix}"
    options = {"quality": 100, "subsampling": 0} if suffix == ".jpg" else {}
    Image.fromarray(np.ascontiguousarray(stored)).save(path, exif=exif, **options)
    assert image_size(path) == (40, 24)
    pixels = read_straight(path)
    assert pixels.shape == (24, 40, 4)
    np.testing.assert_allclose(pixels[2:6, 2:6, :3].mean((0, 1)), [1, 0, 0], atol=0.05)
    np.testing.assert_allclose(pixels[2:6, -6:-2, :3].mean((0, 1)), [0, 1, 0], atol=0.05)


def test_an_orientation_that_is_no_number_is_upright(tmp_path: Path) -> None:
    exif = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">HHHIII", 1, EXIF_ORIENTATION, 1, 1, 0x01000000, 0)  # a byte
    Image.new("RGB", (40, 24)).save(tmp_path / "photo.jpg", exif=exif)
    assert image_size(tmp_path / "photo.jpg") == (40, 24)


def test_poses_for_the_stored_orientation_keep_it(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[EXIF_ORIENTATION] = 6
    Image.new("RGB", (40, 24)).save(tmp_path / "photo.jpg", exif=exif)
    assert image_size(tmp_path / "photo.jpg") == (24, 40)
    assert image_size(tmp_path / "photo.jpg", (40, 24)) == (40, 24)
    assert read_straight(tmp_path / "photo.jpg", (40, 24)).shape == (24, 40, 4)
    assert read_straight(tmp_path / "photo.jpg", (24, 40)).shape == (40, 24, 4)


def test_exr_is_linear_premultiplied_and_its_alpha_optional(tmp_path: Path) -> None:
    planes = {name: GENERATOR.uniform(0, 2, size=(4, 5)).astype(np.float32) for name in "RGB"}
    linear = np.stack([planes[name] for name in "RGB"], -1)
    write_exr(tmp_path / "a.exr", planes, half=False)
    pixels = read_straight(tmp_path / "a.exr")
    np.testing.assert_allclose(linear_from_srgb(pixels[..., :3]), linear, atol=1e-5)
    assert (pixels[..., 3] == 1).all() and image_size(tmp_path / "a.exr") == (5, 4)
    write_exr(tmp_path / "b.exr", {"Y": planes["R"]}, half=False)
    np.testing.assert_allclose(linear_from_srgb(read_straight(tmp_path / "b.exr")[..., 2]), planes["R"], atol=1e-5)
    quarter = {**{name: plane * 0.25 for name, plane in planes.items()}, "A": np.full((4, 5), 0.25, np.float32)}
    write_exr(tmp_path / "c.exr", quarter, half=False)
    np.testing.assert_allclose(read_straight(tmp_path / "c.exr")[..., :3], pixels[..., :3], atol=1e-5)


def test_spoilt_exr(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"depth": np.ones((4, 5), np.float32)})
    with pytest.raises(UserError, match="lacks colour"):
        read_straight(tmp_path / "a.exr")
    write_exr(tmp_path / "b.exr", {name: np.full((4, 5), np.nan, np.float32) for name in "RGB"})
    with pytest.raises(UserError, match="not finite"):
        read_straight(tmp_path / "b.exr")
    (tmp_path / "c.exr").write_bytes(b"v/1\x01 nothing more")
    with pytest.raises(UserError, match="cannot be read"):
        image_size(tmp_path / "c.exr")
