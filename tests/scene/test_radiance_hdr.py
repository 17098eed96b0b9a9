from pathlib import Path

import numpy as np
import pytest

from illuminerf.scene.radiance_hdr import read_hdr
from illuminerf.workflow.errors import UserError


def encoded(linear_rgb: np.ndarray) -> np.ndarray:
    """A straightforward RGBE encoder."""
    largest = linear_rgb.max(-1)
    mantissa, exponent = np.frexp(largest)
    scale = np.where(largest > 1e-32, mantissa * 256 / np.maximum(largest, 1e-32), 0)
    rgbe = np.concatenate([linear_rgb * scale[..., None], (exponent + 128)[..., None]], -1)
    return np.where(largest[..., None] > 1e-32, rgbe, 0).astype(np.uint8)


def flat_file(rgbe: np.ndarray) -> bytes:
    height, width = rgbe.shape[:2]
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + f"-Y {height} +X {width}\n".encode() + rgbe.tobytes()


def run_length_file(rgbe: np.ndarray) -> bytes:
    height, width = rgbe.shape[:2]
    body = b""
    for row in rgbe:
        body += bytes([2, 2, width >> 8, width & 255])
        for channel in row.T:
            for start in range(0, width, 4):  # alternate runs and literal stretches
                part = channel[start : start + 4]
                same = (part == part[0]).all()
                body += bytes([128 + len(part), part[0]]) if same else bytes([len(part)]) + part.tobytes()
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + f"-Y {height} +X {width}\n".encode() + body


def picture() -> np.ndarray:
    image = np.random.default_rng(0).uniform(0, 4, (6, 12, 3))
    image[2:4] = 0.25
    image[0, 0] = 9000.0
    image[5, 5] = 0
    return image


@pytest.mark.parametrize("writer", [flat_file, run_length_file])
def test_both_codings_are_read(tmp_path: Path, writer) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "a.hdr").write_bytes(writer(encoded(picture())))
    image = read_hdr(tmp_path / "a.hdr")
    tolerance = picture().max(-1, keepdims=True) / 200
    assert (np.abs(image - picture()) <= tolerance).all()
    assert not (np.abs(image * 1.02 - picture()) <= tolerance).all(), "a slip of 2% must be seen"


def test_agrees_with_an_independent_reader(tmp_path: Path) -> None:
    mitsuba = pytest.importorskip("mitsuba")
    before = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    (tmp_path / "a.hdr").write_bytes(run_length_file(encoded(picture())))
    theirs = np.array(mitsuba.Bitmap(str(tmp_path / "a.hdr")).convert(component_format=mitsuba.Struct.Type.Float32))
    if before is not None:
        mitsuba.set_variant(before)  # other tests of this process render with it
    # theirs takes the lower end of each quantisation step, ours its middle
    assert (np.abs(read_hdr(tmp_path / "a.hdr") - theirs) <= theirs.max(-1, keepdims=True) / 200).all()


@pytest.mark.parametrize("keep", [10, 60, 100])
def test_truncated_files_are_refused(tmp_path: Path, keep: int) -> None:
    (tmp_path / "a.hdr").write_bytes(run_length_file(encoded(picture()))[:keep])
    with pytest.raises(UserError, match="truncated|not a readable"):
        read_hdr(tmp_path / "a.hdr")


def test_bombs_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\n\n-Y 99999 +X 199998\n")
    with pytest.raises(UserError, match="impossible size"):
        read_hdr(tmp_path / "a.hdr")
