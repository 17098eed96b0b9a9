"""Gallery videos to the benchmark's layout: small videos of a known disc, and the published ones where they are."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.gallery_alpha import object_mask, straight_on_white
from illuminerf.data.tensoir import find_test_views, load_test_cameras, load_test_image
from illuminerf.evaluation.benchmark_rule import on_white
from illuminerf.scene.cameras import sphere_cameras
from illuminerf.scene.images import read_png
from illuminerf.scene.video import read_video, write_mp4
from illuminerf.stages.unpack_tensoir_gallery import LIGHTS, Config, run
from illuminerf.workflow.errors import UserError

SIZE, NUM_TRAIN, NUM_TEST = 64, 3, 4
FOV = 0.69


def disc(view: int) -> np.ndarray:
    """bool: a disc that moves from view to view."""
    rows, columns = np.indices((SIZE, SIZE)) + 0.5
    return (rows - 30) ** 2 + (columns - 26 - 4 * view) ** 2 < 18**2


def frames(num_frames: int, colour: tuple[float, float, float]) -> list[np.ndarray]:
    return [np.where(disc(view)[..., None], colour, 1.0) for view in range(num_frames)]


def write_gallery(root: Path, scene: str = "mug", methods: tuple[str, ...] = ("ours",)) -> tuple[Path, Path]:
    """(videos, cameras)."""
    videos, cameras = root / "videos", root / "cameras"
    cameras.mkdir(parents=True, exist_ok=True)
    write_mp4(videos / f"{scene}-input.mp4", frames(NUM_TRAIN, (0.7, 0.3, 0.2)))
    write_mp4(videos / f"{scene}-src_spin.mp4", frames(NUM_TEST, (0.7, 0.3, 0.2)))
    for index, light in enumerate(LIGHTS):
        # under the first light the object is as white as what is behind it
        colour = (1.0, 1.0, 1.0) if index == 0 else (0.2 + 0.1 * index, 0.5, 0.4)
        for ending in ("gt", *methods):
            write_mp4(videos / f"{scene}-{light}-{ending}.mp4", frames(NUM_TEST, colour))
    for split, count in (("train", NUM_TRAIN), ("test", NUM_TEST)):
        poses = sphere_cameras(count, 4.0, FOV, SIZE, SIZE, np.random.default_rng(count)).world_from_camera
        entries = [{"file_path": f"./{split}/r_{view}", "transform_matrix": pose.tolist()}
                   for view, pose in enumerate(poses)]  # fmt: skip
        content = {"camera_angle_x": FOV, "frames": entries}
        (cameras / f"transforms_{split}.json").write_text(json.dumps(content))
    return videos, cameras


@pytest.fixture(scope="module")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_gallery(tmp_path_factory.mktemp("gallery"))


@pytest.fixture(scope="module")
def unpacked(gallery: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(*gallery, Config(size=SIZE), tmp_path_factory.mktemp("out"))


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def test_the_layout_is_the_benchmarks(unpacked: Path, gallery: tuple[Path, Path]) -> None:
    scene = unpacked / "mug"
    assert find_test_views(scene, [*LIGHTS, "sunset"]) == [f"test_{view:03d}" for view in range(NUM_TEST)]
    assert sorted(path.name for path in scene.glob("train_*")) == [f"train_{view:03d}" for view in range(NUM_TRAIN)]
    assert [path.name for path in (scene / "train_000").iterdir() if path.suffix == ".png"] == ["rgba_sunset.png"]
    _, cameras = load_test_cameras(scene)
    written = json.loads((gallery[1] / "transforms_test.json").read_text())
    poses = [frame["transform_matrix"] for frame in written["frames"]]
    np.testing.assert_allclose(cameras.world_from_camera, poses, atol=1e-9)
    np.testing.assert_allclose(cameras.intrinsics[:, 0], SIZE / 2 / np.tan(FOV / 2))


@pytest.mark.parametrize("view", range(NUM_TEST))
def test_alpha_is_the_disc_under_every_light(unpacked: Path, view: int) -> None:
    for light in (*LIGHTS, "sunset"):
        alpha = load_test_image(unpacked / "mug", f"test_{view:03d}", light)[..., 3]
        assert overlap(alpha > 0.5, disc(view)) > 0.9, "colour bleeds by half a pixel in such a small video"
        assert overlap(alpha > 0.5, disc((view + 1) % NUM_TEST)) < 0.87


def test_pictures_show_the_frames_on_white(unpacked: Path, gallery: tuple[Path, Path]) -> None:
    frame = list(read_video(gallery[0] / "mug-city-gt.mp4", SIZE))[2]
    image = load_test_image(unpacked / "mug", "test_002", "city")
    inside = image[..., 3] == 1
    np.testing.assert_allclose(on_white(image)[inside] * 255, frame[inside], atol=0.01)
    assert (on_white(image)[image[..., 3] == 0] == 1).all()


def test_published_renderings_are_taken_where_they_are(unpacked: Path) -> None:
    folder = unpacked / "published" / "illuminerf" / "mug" / "night"
    assert len(list(folder.iterdir())) == NUM_TEST
    assert read_png(folder / "test_001.png").shape == (SIZE, SIZE, 3)
    assert not (unpacked / "published" / "tensoir").exists()


def test_smaller_pictures_have_soft_rims_and_every_second_view(
    gallery: tuple[Path, Path], unpacked: Path, tmp_path: Path
) -> None:
    out = run(*gallery, Config(scenes=("mug",), size=16, every=2), tmp_path / "out")
    assert find_test_views(out / "mug", ["city"]) == ["test_000", "test_002"]
    alpha = load_test_image(out / "mug", "test_002", "city")[..., 3]
    whole = load_test_image(unpacked / "mug", "test_002", "city")[..., 3]
    np.testing.assert_allclose(alpha, whole.reshape(16, 4, 16, 4).mean((1, 3)), atol=1 / 255)
    assert np.abs((alpha > 0.5) - alpha).max() > 0.2, "a mask without soft rims"
    frame = list(read_video(gallery[0] / "mug-city-gt.mp4", 16))[2]
    shown = on_white(load_test_image(out / "mug", "test_002", "city")) * 255
    assert np.abs(shown - frame)[alpha > 0.3].max() < 3


def test_what_is_there_is_kept(gallery: tuple[Path, Path], unpacked: Path, tmp_path: Path) -> None:
    shutil.copytree(unpacked, tmp_path / "out")
    shutil.rmtree(tmp_path / "out" / "mug" / "test_001")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*.png")}
    run(*gallery, Config(size=SIZE), tmp_path / "out")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    again = (tmp_path / "out" / "mug" / "test_001" / "rgba_city.png").read_bytes()
    assert again == (unpacked / "mug" / "test_001" / "rgba_city.png").read_bytes()
    with pytest.raises(UserError, match="another size"):
        run(*gallery, Config(size=32), tmp_path / "out")


def test_mistakes_are_told_before_anything_is_written(gallery: tuple[Path, Path], tmp_path: Path) -> None:
    videos, cameras = gallery
    out = tmp_path / "out"
    with pytest.raises(UserError, match="no vase-input.mp4.*scenes there: mug"):
        run(videos, cameras, Config(scenes=("vase",)), out)
    with pytest.raises(UserError, match="no gallery videos"):
        run(cameras, cameras, Config(), out)
    with pytest.raises(UserError, match="64 x 64 pixels"):
        run(videos, cameras, Config(size=800), out)
    shutil.copytree(videos, tmp_path / "videos")
    shutil.copy(videos / "mug-input.mp4", tmp_path / "videos" / "mug-city-gt.mp4")
    with pytest.raises(UserError, match="3 frames in .*mug-city-gt.mp4, 4 cameras"):
        run(tmp_path / "videos", cameras, Config(size=SIZE), out)
    (tmp_path / "videos" / "mug-city-gt.mp4").write_bytes(b"no video")
    with pytest.raises(UserError, match="mug-city-gt.mp4 is not a readable video"):
        run(tmp_path / "videos", cameras, Config(size=SIZE), out)
    with pytest.raises(UserError, match="transforms_train.json is missing"):
        run(videos, videos, Config(size=SIZE), out)
    assert not out.exists()


def test_highlights_stay_and_holes_open() -> None:
    """A white spot inside the object is a highlight under one light; white under all lights is a hole."""
    frame = np.full((200, 200, 3), 255, np.uint8)
    frame[50:150, 50:150] = 90
    lit = frame.copy()
    lit[100, 100] = 255
    assert object_mask([lit])[100, 100]
    assert object_mask([lit, frame])[100, 100]
    hole = frame.copy()
    hole[80:90, 80:90] = 255
    assert not object_mask([hole, hole])[85, 85] and not object_mask([hole])[85, 85]
    assert object_mask([hole, frame])[85, 85], "white under one of two lights is no hole"
    specks = frame.copy()
    specks[10, 10] = 200
    assert not object_mask([specks])[10, 10]


def test_straight_colour_undoes_white() -> None:
    alpha = np.array([[0.0, 0.25, 1.0]], np.float32)
    colour = np.full((1, 3, 3), 0.4)
    frame = colour * alpha[..., None] + 1 - alpha[..., None]
    rgba = straight_on_white(frame, alpha)
    np.testing.assert_allclose(rgba[0, 1:, :3], 0.4, atol=1e-6)
    np.testing.assert_allclose(on_white(rgba), frame, atol=1e-6)


@pytest.mark.data
@pytest.mark.slow
def test_the_published_gallery_gives_the_frames_of_another_unpacking(data_root: Path, tmp_path: Path) -> None:
    """$ILLUMINERF_DATA/gallery/{videos,cameras} against $ILLUMINERF_DATA/tensoir, unpacked with binary alpha."""
    gallery, other = data_root / "gallery", data_root / "tensoir"
    if not (gallery / "videos" / "hotdog-input.mp4").is_file() or not (other / "hotdog" / "test_000").is_dir():
        pytest.skip("no gallery/videos with hotdog, or no tensoir/hotdog, under ILLUMINERF_DATA")
    size = load_test_image(other / "hotdog", "test_000", "city").shape[0]
    out = run(gallery / "videos", gallery / "cameras", Config(scenes=("hotdog",), size=size, every=50), tmp_path)
    for name in ("test_000", "test_100"):
        for light in LIGHTS:
            ours, theirs = (load_test_image(root / "hotdog", name, light) for root in (out, other))
            assert overlap(ours[..., 3] > 0.5, theirs[..., 3] > 0.5) > 0.98
            inside = (ours[..., 3] == 1) & (theirs[..., 3] == 1)
            assert np.abs(ours - theirs)[inside].max() * 255 < 1.01
            assert np.abs(on_white(ours) - on_white(theirs)).mean() * 255 < 0.1
    published = out / "published" / "illuminerf" / "hotdog" / "city" / "test_100.png"
    expected = other / "published" / "illuminerf" / "hotdog" / "city" / "test_100.png"
    assert np.abs(read_png(published) - read_png(expected)).max() * 255 < 1.01
