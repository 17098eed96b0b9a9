"""Everything a person can hand over that is not a capture: one clear error, and no output folder."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from illuminerf.data.capture import load_capture
from illuminerf.data.source import rigid_pose
from illuminerf.stages.import_capture import Config, run
from illuminerf.workflow.errors import UserError
from tests.data.synthetic_capture import ball_cameras, ball_images, write_plain, write_tensoir, write_transforms

CAMERAS = ball_cameras(4, 20, 24)
IMAGES = ball_images(CAMERAS)


def edit_json(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def png_header(width: int, height: int) -> bytes:
    """A PNG that promises width x height pixels in a few bytes."""
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    data = b"IDAT" + zlib.compress(bytes(100))
    chunks = (
        struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in (body, data, b"IEND")
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def first_pose(change: Callable[[np.ndarray], object]) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        def edit(content: dict[str, Any]) -> None:
            pose = np.array(content["frames"][0]["transform_matrix"])
            change(pose)
            content["frames"][0]["transform_matrix"] = pose.tolist()

        edit_json(root, edit)

    return apply


def _set(index: Any, value: float) -> Callable[[np.ndarray], object]:
    return lambda pose: pose.__setitem__(index, value)


def _scale(factor: float) -> Callable[[np.ndarray], object]:
    return lambda pose: pose.__setitem__((slice(0, 3), slice(0, 3)), pose[:3, :3] * factor)


def frame(key: str, value: Any, index: int = 0) -> Callable[[Path], None]:
    return lambda root: edit_json(root, lambda content: content["frames"][index].update({key: value}))


def image_bytes(content: bytes) -> Callable[[Path], None]:
    return lambda root: (root / "images" / "00.png").write_bytes(content) and None


def truncate(root: Path) -> None:
    path = root / "images" / "01.png"
    path.write_bytes(path.read_bytes()[:-60])


def resize_first(root: Path) -> None:
    Image.fromarray(IMAGES[0]).resize((48, 40)).save(root / "images" / "00.png")
    edit_json(root, lambda content: (content.pop("w"), content.pop("h")))


def save_cmyk(root: Path) -> None:
    Image.new("CMYK", (24, 20)).save(root / "images" / "00.jpg")
    frame("file_path", "images/00.jpg")(root)


def link_out(root: Path) -> None:
    outside = root.parent / "outside.png"
    Image.fromarray(IMAGES[0]).save(outside)
    (root / "images" / "00.png").unlink()
    (root / "images" / "00.png").symlink_to(outside)


CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no frames": (lambda root: edit_json(root, lambda c: c["frames"].clear()), "no posed images"),
    "two views": (lambda root: edit_json(root, lambda c: c["frames"].__delitem__(slice(2, None))), "too few views"),
    "frames is a number": (lambda root: edit_json(root, lambda c: c.update(frames=3)), "does not list frames"),
    "corrupt JSON": (lambda root: (root / "transforms.json").write_text('{"frames": ['), "not valid JSON"),
    "JSON that is a list": (lambda root: (root / "transforms.json").write_text("[1, 2]"), "does not list frames"),
    "NaN pose": (first_pose(_set((0, 3), np.nan)), "not finite"),
    "infinite pose": (first_pose(_set((2, 3), np.inf)), "not finite"),
    "scaled pose": (first_pose(_scale(2.0)), "not rigid"),
    "mirrored pose": (first_pose(_scale(-1.0)), "not rigid"),
    "projective pose": (first_pose(_set((3, 0), 1.0)), "not rigid"),
    "3 x 3 pose": (frame("transform_matrix", [[1, 0, 0]] * 3), "not a matrix"),
    "text for a pose": (frame("transform_matrix", "identity"), "not a matrix"),
    "no pose": (lambda root: edit_json(root, lambda c: c["frames"][1].pop("transform_matrix")), "has no pose"),
    "no file name": (lambda root: edit_json(root, lambda c: c["frames"][1].pop("file_path")), "names no image"),
    "missing image": (lambda root: (root / "images" / "02.png").unlink(), "missing"),
    "path with dots": (frame("file_path", "../outside.png"), "outside its own folder"),
    "absolute path": (frame("file_path", "/etc/hostname"), "outside its own folder"),
    "mask outside": (frame("mask_path", "../../mask.png"), "outside its own folder"),
    "name is a table beside a split": (
        lambda root: (
            frame("file_path", {})(root),
            edit_json(root, lambda c: c.update(train_filenames=["images/01.png"])),
        ),
        "too few views",
    ),
    "endless name": (frame("file_path", "a" * 300 + ".png"), "cannot be resolved"),
    "link to outside": (link_out, "outside its own folder"),
    "sizes differ": (resize_first, "differing size"),
    "other aspect": (lambda root: Image.new("RGBA", (20, 20)).save(root / "images/00.png"), "another shape"),
    "not an image": (image_bytes(b"<html>404</html>"), "cannot be read"),
    "empty file": (image_bytes(b""), "cannot be read"),
    "truncated image": (truncate, "cannot be read"),
    "CMYK": (save_cmyk, "colour space"),
    "bomb": (image_bytes(png_header(60_000, 60_000)), "impossible size"),
    "half a bomb": (image_bytes(png_header(13_000, 13_000)), "impossible size"),
    "empty alpha": (lambda root: Image.new("RGBA", (24, 20)).save(root / "images/00.png"), "nothing of the object"),
    "negative focal length": (lambda root: edit_json(root, lambda c: c.update(fl_x=-3)), "not those of a camera"),
    "no focal length": (lambda root: edit_json(root, lambda c: (c.pop("fl_x"), c.pop("fl_y"))), "no focal length"),
    "focal length is text": (lambda root: edit_json(root, lambda c: c.update(fl_x="wide")), "not numbers"),
    "fisheye": (lambda root: edit_json(root, lambda c: c.update(camera_model="OPENCV_FISHEYE")), "not supported"),
    "one camera position": (
        lambda root: edit_json(
            root,
            lambda c: [f.update(transform_matrix=c["frames"][0]["transform_matrix"]) for f in c["frames"]],
        ),
        "at one point",
    ),
}


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_explained_and_leaves_nothing(tmp_path: Path, name: str) -> None:
    root = tmp_path / "source"
    write_transforms(root, CAMERAS, IMAGES)
    spoil, message = CASES[name]
    spoil(root)
    with pytest.raises(UserError, match=message) as caught:
        run(root, Config(), tmp_path / "capture")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "capture").exists()


def test_the_unspoilt_folder_is_fine(tmp_path: Path) -> None:
    """Guard: the cases above fail for their own reason."""
    write_transforms(tmp_path / "source", CAMERAS, IMAGES)
    run(tmp_path / "source", Config(), tmp_path / "capture")


def test_empty_mask_files_and_wrong_mask_sizes(tmp_path: Path) -> None:
    write_transforms(tmp_path / "source", CAMERAS, IMAGES, with_masks=True)
    mask = tmp_path / "source" / "masks" / "01.png"
    Image.new("L", (24, 20)).save(mask)
    with pytest.raises(UserError, match="nothing of the object.*01.png"):
        run(tmp_path / "source", Config(), tmp_path / "capture")
    Image.new("L", (48, 40), 255).save(mask)
    with pytest.raises(UserError, match="another size than its image"):
        run(tmp_path / "source", Config(), tmp_path / "capture")


def test_missing_empty_and_foreign_folders(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "photos").mkdir()
    Image.fromarray(IMAGES[0]).save(tmp_path / "photos" / "a.png")
    (tmp_path / "file").write_text("")
    for name, message in (
        ("nowhere", "does not exist"),
        ("empty", "an empty folder"),
        ("photos", "no camera poses.*a.png"),
        ("file", "not a folder"),
    ):
        with pytest.raises(UserError, match=message):
            run(tmp_path / name, Config(), tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


def test_inverted_masks_and_opencv_axes_are_told(tmp_path: Path) -> None:
    flipped = CAMERAS.world_from_camera.copy()
    flipped[:, :, 1:3] *= -1
    content = CAMERAS.to_dict()
    for entry, pose in zip(content["frames"], flipped, strict=True):
        entry["world_from_camera"] = pose.tolist()
    write_plain(tmp_path / "opencv", CAMERAS, IMAGES)
    (tmp_path / "opencv" / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="OpenCV poses"):
        run(tmp_path / "opencv", Config(), tmp_path / "capture")


def test_tensoir_lights_and_metadata_are_checked(tmp_path: Path) -> None:
    write_tensoir(tmp_path / "scene", CAMERAS, IMAGES)
    with pytest.raises(UserError, match="light 'noon'; got lights sunset"):
        run(tmp_path / "scene", Config(light="noon"), tmp_path / "capture")
    (tmp_path / "scene" / "train_001" / "metadata.json").write_text('{"cam_angle_x": 0.7}')
    with pytest.raises(UserError, match="cam_transform_mat"):
        run(tmp_path / "scene", Config(), tmp_path / "capture")


def test_plain_folders_need_one_image_per_camera(tmp_path: Path) -> None:
    write_plain(tmp_path / "source", CAMERAS, IMAGES)
    (tmp_path / "source" / "images" / "3.png").unlink()
    with pytest.raises(UserError, match="3 images in .* and 4 frames"):
        run(tmp_path / "source", Config(), tmp_path / "capture")


def test_spoilt_captures_do_not_load(tmp_path: Path) -> None:
    write_transforms(tmp_path / "source", CAMERAS, IMAGES)
    out = run(tmp_path / "source", Config(), tmp_path / "capture")
    with pytest.raises(UserError, match="not a capture"):
        load_capture(tmp_path / "source")
    Image.new("RGBA", (5, 5)).save(out / "images" / "000.png")
    with pytest.raises(UserError, match="wrong shape"):
        load_capture(out)
    (out / "DONE").unlink()
    with pytest.raises(UserError, match="unfinished"):
        load_capture(out)


@given(st.lists(st.lists(st.floats(width=64), min_size=4, max_size=4), min_size=3, max_size=4))
@settings(max_examples=200, deadline=None)
def test_any_matrix_is_a_rotation_or_an_error(rows: list[list[float]]) -> None:
    try:
        pose = rigid_pose(rows, "here")
    except UserError:
        return
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) > 0


@given(seed=st.integers(0, 1000), jitter=st.floats(0, 1e-4))
@settings(max_examples=50, deadline=None)
def test_rounded_rotations_are_accepted_and_repaired(seed: int, jitter: float) -> None:
    generator = np.random.default_rng(seed)
    q, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    rotation = q * np.sign(np.linalg.det(q))
    pose = np.eye(4)
    pose[:3, :3] = rotation + generator.uniform(-jitter, jitter, (3, 3))
    np.testing.assert_allclose(rigid_pose(pose.tolist(), "here")[:3, :3], rotation, atol=1e-3)
