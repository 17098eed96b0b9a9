import resource
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from illuminerf.scene.images import (
    composite,
    linear_from_srgb,
    read_exr,
    read_png,
    read_png_bytes,
    srgb_from_linear,
    write_exr,
    write_png,
)
from illuminerf.workflow.errors import UserError


@given(st.floats(0, 16, width=32))
def test_srgb_round_trip(value: float) -> None:
    linear = np.array([value], np.float32)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(linear)), linear, atol=1e-6, rtol=1e-5)


def test_srgb_known_values_and_guard() -> None:
    assert srgb_from_linear(np.array([0.5]))[0] == pytest.approx(0.7353570, abs=1e-6)
    assert abs(0.5 ** (1 / 2.2) - 0.7353570) > 1e-3, "a plain power law must not pass for sRGB"


def test_torch_and_numpy_agree_and_gradients_are_finite() -> None:
    values = torch.tensor([0.0, 1e-6, 0.0031308, 0.2, 1.0, 9.0], requires_grad=True)
    coded = srgb_from_linear(values)
    np.testing.assert_allclose(coded.detach().numpy(), srgb_from_linear(values.detach().numpy()), atol=1e-6)
    coded.sum().backward()
    assert torch.isfinite(values.grad).all()


def test_compositing() -> None:
    colour, alpha = np.full((2, 2, 3), 0.4), np.array([[0.0, 0.5], [1.0, 0.25]])
    np.testing.assert_allclose(composite(colour, alpha, 1.0)[..., 0], [[1.0, 0.7], [0.4, 0.85]])


def test_transparency_without_a_palette_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    header = struct.pack(">IIBBBBB", 1, 1, 8, 3, 0, 0, 0)  # indexed colours
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(2))), (b"tRNS", b"\0"), (b"IEND", b""))
    parts = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    (tmp_path / "bare.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    with pytest.raises(UserError, match=r"bare\.png is not a readable image"):
        read_png_bytes(tmp_path / "bare.png")


def test_png_round_trip(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 4)).astype(np.float32) / 255
    write_png(tmp_path / "image.png", image)
    np.testing.assert_array_equal(read_png(tmp_path / "image.png"), image)


def test_exr_round_trip_half_and_single(tmp_path: Path) -> None:
    channels = {
        "diffuse.R": np.linspace(0, 9, 12, dtype=np.float32).reshape(3, 4),
        "A": np.ones((3, 4), np.float32),
    }
    write_exr(tmp_path / "a.exr", channels, half=False)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["diffuse.R"], channels["diffuse.R"])
    write_exr(tmp_path / "b.exr", channels)
    np.testing.assert_allclose(read_exr(tmp_path / "b.exr")["diffuse.R"], channels["diffuse.R"], rtol=1e-3)


def test_values_beyond_half_are_clamped(tmp_path: Path) -> None:
    write_exr(tmp_path / "sun.exr", {"R": np.full((2, 2), 1e6, np.float32)})
    assert read_exr(tmp_path / "sun.exr")["R"].max() == 65504


@pytest.mark.parametrize("reader", [read_png, read_exr])
def test_missing_and_broken_files_are_named(tmp_path: Path, reader) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(UserError, match="missing"):
        reader(tmp_path / "absent")
    (tmp_path / "broken").write_bytes(b"\x89PNG nonsense")
    with pytest.raises(UserError, match="not a readable"):
        reader(tmp_path / "broken")


def test_an_exr_is_whole_or_an_error(tmp_path: Path) -> None:
    """At every size that files may have at most, as on a disk that is full: the library hides what fails at its end."""
    channels = {name: np.random.default_rng(3).random((12, 12), np.float32) for name in "RGBA"}
    write_exr(tmp_path / "whole.exr", channels)
    whole = (tmp_path / "whole.exr").read_bytes()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    num_refused = 0
    for most in range(200, len(whole) + 40, 23):
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
        try:
            write_exr(tmp_path / "limited.exr", channels)
        except UserError:
            num_refused += 1
            assert most < len(whole) and not (tmp_path / "limited.exr").exists()
        else:
            assert (tmp_path / "limited.exr").read_bytes() == whole
            break
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert num_refused > 20
