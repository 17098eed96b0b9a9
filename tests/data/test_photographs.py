"""Folders of photographs as cameras write them, and where their masks come from."""

import sys
import types
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from illuminerf.data.object_masks import settle_masks
from illuminerf.data.photographs import GUESSED_FOCAL, left_out, photographs_of, read_shot
from illuminerf.workflow.errors import UserError

NOISE = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)


def write(folder: Path, names: list[str], image: np.ndarray = NOISE, **options: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.fromarray(image).save(folder / name, **options)
    return folder


def exif(focal: int | None = None, seconds: Fraction | None = None, turned: int | None = None) -> Image.Exif:
    found = Image.Exif()
    values = found.get_ifd(0x8769)
    if focal:
        values[0xA405] = focal
    if seconds:
        values[0x829A], values[0x829D], values[0x8827] = float(seconds), 2.0, 100
    if turned:
        found[0x0112] = turned
    return found


def test_photographs_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    write(tmp_path / "a", ["IMG_10.jpg", "IMG_2.JPG", "IMG_1.png"])
    (tmp_path / "a" / "notes.txt").write_text("light: window")
    frames = photographs_of(tmp_path / "a", "masks", 9, tmp_path)
    assert [frame.name for frame in frames] == ["IMG_1", "IMG_2", "IMG_10"]
    assert frames[0].camera.fx == GUESSED_FOCAL * 40 and frames[0].mask is None


def test_photographs_in_images_find_their_masks(tmp_path: Path) -> None:
    write(tmp_path / "images", ["1.jpg", "2.jpg", "3.jpg"])
    write(tmp_path / "masks", ["1.png", "2.jpg.png"])
    frames = photographs_of(tmp_path, "masks", 9, tmp_path)
    assert [frame.mask.name if frame.mask else None for frame in frames] == ["1.png", "2.jpg.png", None]
    with pytest.raises(UserError, match=r"lack their masks; got none for 3\.jpg"):
        settle_masks(frames, "auto", tmp_path)


def test_the_focal_length_of_exif_is_read_and_turned_photographs_stand_upright(tmp_path: Path) -> None:
    write(tmp_path, ["1.jpg", "2.jpg", "3.jpg"], exif=exif(focal=27, seconds=Fraction(1, 50), turned=6))
    camera = photographs_of(tmp_path, "masks", 9, tmp_path)[0].camera
    assert (camera.width, camera.height) == (30, 40)
    assert camera.fx == pytest.approx(27 / 36 * 40)
    assert read_shot(tmp_path / "1.jpg").exposure == pytest.approx(1 / 50 / 4 * 100)
    write(tmp_path, ["4.jpg"])
    assert read_shot(tmp_path / "4.jpg").exposure is None


def test_what_is_no_capture_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="missing"):
        photographs_of(tmp_path / "nowhere", "masks", 9, tmp_path)
    write(tmp_path / "two", ["1.jpg", "2.jpg"])
    with pytest.raises(UserError, match="too few photographs; got 2"):
        photographs_of(tmp_path / "two", "masks", 9, tmp_path)
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone" / "IMG_1.HEIC").write_bytes(b"")
    with pytest.raises(UserError, match=r"format that is not read; got 1 files such as IMG_1\.HEIC"):
        photographs_of(tmp_path / "phone", "masks", 9, tmp_path)
    write(tmp_path / "twice", ["1.jpg", "1.png", "2.jpg"])
    with pytest.raises(UserError, match="one name"):
        photographs_of(tmp_path / "twice", "masks", 9, tmp_path)


def test_photographs_that_are_left_out_beside_others_are_named(tmp_path: Path) -> None:
    write(tmp_path / "phone" / "images", ["1.jpg", "2.jpg", "3.jpg"])
    assert left_out(tmp_path / "phone") == []
    for name in ("IMG_5.HEIC", "IMG_4.HEIC", "notes.txt"):
        (tmp_path / "phone" / "images" / name).write_bytes(b"")
    assert left_out(tmp_path / "phone") == ["IMG_4.HEIC", "IMG_5.HEIC"]
    assert len(photographs_of(tmp_path / "phone", "masks", 9, tmp_path)) == 3
    assert left_out(tmp_path / "film.mp4") == []


def _cut_out_image(colour: tuple[int, int, int] | None) -> np.ndarray:
    """A noisy square, before `colour` or with alpha."""
    inside = np.zeros((30, 40, 1), bool)
    inside[8:22, 10:30] = True
    if colour is None:
        return np.concatenate([NOISE, np.where(inside, 255, 0).astype(np.uint8)], -1)
    return np.where(inside, NOISE, np.array(colour, np.uint8))


@pytest.mark.parametrize(
    ("image", "source"),
    [(_cut_out_image(None), "alpha"), (_cut_out_image((30, 160, 60)), "plain"), (NOISE, "none")],
    ids=["alpha", "plain", "none"],
)
def test_the_source_of_masks_is_found(tmp_path: Path, image: np.ndarray, source: str) -> None:
    frames = photographs_of(write(tmp_path, ["1.png", "2.png", "3.png"], image), "masks", 9, tmp_path)
    masked = settle_masks(frames, "auto", tmp_path)
    assert masked.source == source
    alpha = masked.cut(masked.frames[0])[..., 3] > 127
    assert alpha.mean() == pytest.approx(1.0 if source == "none" else 14 * 20 / 1200, abs=0.05)


def test_wishes_that_cannot_be_met_are_refused(tmp_path: Path) -> None:
    frames = photographs_of(write(tmp_path, ["1.png", "2.png", "3.png"]), "masks", 9, tmp_path)
    with pytest.raises(UserError, match="no transparent pixels"):
        settle_masks(frames, "alpha", tmp_path)
    with pytest.raises(UserError, match="not plain"):
        settle_masks(frames, "plain", tmp_path)


def test_a_network_cuts_out_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for rembg, which keeps the left half and is unsure about the rest."""

    def remove(image: Image.Image, session: object, only_mask: bool) -> Image.Image:
        assert session == "isnet-general-use" and only_mask
        mask = np.full((image.height, image.width), 1, np.uint8)
        mask[:, : image.width // 2] = 254
        return Image.fromarray(mask)

    monkeypatch.setitem(sys.modules, "rembg", types.SimpleNamespace(new_session=lambda name: name, remove=remove))
    frames = photographs_of(write(tmp_path, ["1.png", "2.png", "3.png"]), "masks", 9, tmp_path)
    masked = settle_masks(frames, "rembg", tmp_path / "cut")
    alpha = masked.cut(masked.frames[0])[..., 3]
    assert (alpha[:, :20] == 255).all() and (alpha[:, 20:] == 0).all()
    monkeypatch.setitem(sys.modules, "rembg", None)
    with pytest.raises(UserError, match=r"pip install 'illuminerf\[cutout\]'"):
        settle_masks(frames, "rembg", tmp_path / "again")
