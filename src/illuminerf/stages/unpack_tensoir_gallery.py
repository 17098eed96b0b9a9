"""The paper's public gallery videos + NeRF-synthetic lego's cameras -> the TensoIR benchmark in its official layout.

    <videos>/<scene>-input.mp4                          the 100 input views under sunset
    <videos>/<scene>-src_spin.mp4                       the 200 test views under sunset
    <videos>/<scene>-<light>-{gt,ours,tensoir}.mp4      under a target light: the truth, the paper's renderings and
                                                        TensoIR's

    <out>/<scene>/{train,test}_000/{rgba_<light>.png, metadata.json}
    <out>/published/{illuminerf,tensoir}/<scene>/<light>/test_000.png

They lie in static/tensoir_results of the repository of the paper's project page. All four scenes were rendered from
lego's cameras. The videos are on white: alpha is found at their full size, where it is 0 or 1, and averaged down.
Pictures then show the very frame on white.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from illuminerf.data.gallery_alpha import object_mask, straight_on_white
from illuminerf.data.resampling import area_downsampled
from illuminerf.data.source import rigid_pose
from illuminerf.data.tensoir import INPUT_LIGHT
from illuminerf.scene.images import write_png
from illuminerf.scene.video import read_video, video_size
from illuminerf.workflow.atomic import read_json, write_bytes
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import step_progress

LIGHTS = ("bridge", "city", "fireplace", "forest", "night")
METHODS = {"ours": "illuminerf", "tensoir": "tensoir"}
"""Endings of the videos that show renderings, and whose they are."""


@dataclass(frozen=True)
class Config:
    """What is unpacked."""

    scenes: tuple[str, ...] = ()
    """By default all whose videos are there."""
    size: int = 800
    """Pixels of a side; the videos' own is 800."""
    every: int = 1
    """Every n-th test view; numbers stay those of the benchmark."""

    def __post_init__(self) -> None:
        if self.size < 16 or self.every < 1:
            raise UserError("size or every is too small", got=f"{self.size}, {self.every}", wanted="16 pixels, 1")


@dataclass(frozen=True)
class _Split:
    """The cameras of the input or the test views."""

    name: str
    poses: tuple[np.ndarray, ...]
    fov_radians: float


@dataclass(frozen=True)
class _Sequence:
    """Videos of the same views, one per light."""

    scene: str
    split: _Split
    videos: dict[str, Path]
    """By light."""


def run(videos: Path, cameras: Path, config: Config, out: Path) -> Path:
    """Unpack the gallery in `videos` into `out`; views that are there are kept.

    Args:
        videos: folder of the videos.
        cameras: folder with NeRF-synthetic lego's transforms_train.json and transforms_test.json.
        config: what is unpacked.
        out: gets the benchmark's layout.

    Raises:
        UserError: before anything is written, where a video or the cameras are missing or are not what they should be.
    """
    train, test = (_read_split(cameras, split) for split in ("train", "test"))
    scenes = config.scenes or _scenes(videos)
    sequences = [sequence for scene in scenes for sequence in _sequences(videos, scene, train, test)]
    published = [(scene, *found) for scene in scenes for found in _published(videos, scene)]
    checks = [(video, len(sequence.split.poses)) for sequence in sequences for video in sequence.videos.values()]
    checks += [(video, len(test.poses)) for *_, video in published]
    native = _checked_size(checks, config.size)
    _refuse_other_size(out, scenes, config.size)
    chosen = {"train": range(len(train.poses)), "test": range(0, len(test.poses), config.every)}
    total = sum(len(chosen[sequence.split.name]) for sequence in sequences) + len(published) * len(chosen["test"])
    with step_progress("unpack", total) as progress:
        for sequence in sequences:
            for _ in _unpacked(sequence, chosen[sequence.split.name], native, config.size, out):
                progress.advance()
        for scene, method, light, video in published:
            folder = out / "published" / method / scene / light
            for _ in _extracted(video, chosen["test"], config.size, folder):
                progress.advance()
    return out


def _unpacked(sequence: _Sequence, chosen: range, native: int, size: int, out: Path) -> Iterator[None]:
    """Write the chosen views of one scene and split; metadata is written last."""
    folders = {index: out / sequence.scene / f"{sequence.split.name}_{index:03d}" for index in chosen}
    missing = {index for index, folder in folders.items() if not (folder / "metadata.json").is_file()}
    yield from [None] * (len(folders) - len(missing))
    if not missing:
        return
    whole = zip(*(read_video(path, native) for path in sequence.videos.values()), strict=True)
    small = zip(*(read_video(path, size) for path in sequence.videos.values()), strict=True)
    for index, (frames, shown) in enumerate(zip(whole, small, strict=True)):
        if index not in missing:
            continue
        mask = object_mask(frames)
        alpha = area_downsampled(mask[..., None].astype(np.float32), size, size)[..., 0]
        for light, frame in zip(sequence.videos, shown, strict=True):
            picture = straight_on_white(frame.astype(np.float32) / 255, alpha)
            write_png(folders[index] / f"rgba_{light}.png", picture)
        matrix = ",".join(repr(float(value)) for value in sequence.split.poses[index].ravel())
        content = {
            "cam_transform_mat": matrix,
            "cam_angle_x": sequence.split.fov_radians,
            "imw": size,
            "imh": size,
        }
        write_bytes(folders[index] / "metadata.json", json.dumps(content).encode())
        yield


def _extracted(video: Path, chosen: range, size: int, folder: Path) -> Iterator[None]:
    """Write the chosen frames of one method's video."""
    paths = {index: folder / f"test_{index:03d}.png" for index in chosen}
    missing = {index for index, path in paths.items() if not path.is_file()}
    yield from [None] * (len(paths) - len(missing))
    if missing:
        for index, frame in enumerate(read_video(video, size)):
            if index in missing:
                write_png(paths[index], frame.astype(np.float32) / 255)
                yield


def _scenes(videos: Path) -> tuple[str, ...]:
    found = sorted(path.stem.removesuffix("-input") for path in videos.glob("*-input.mp4"))
    if not found:
        raise UserError(
            "there are no gallery videos",
            got=f"no <scene>-input.mp4 in {videos}",
            wanted="static/tensoir_results of the repository of the paper's project page",
            fix="clone that repository and name this folder of it",
        )
    return tuple(found)


def _sequences(videos: Path, scene: str, train: _Split, test: _Split) -> list[_Sequence]:
    inputs = {INPUT_LIGHT: videos / f"{scene}-input.mp4"}
    targets = {INPUT_LIGHT: videos / f"{scene}-src_spin.mp4"}
    targets |= {light: videos / f"{scene}-{light}-gt.mp4" for light in LIGHTS}
    for path in (*inputs.values(), *targets.values()):
        if not path.is_file():
            there = sorted({other.name.split("-")[0] for other in videos.glob("*-input.mp4")})
            raise UserError(
                f"a video of the scene {scene!r} is missing",
                got=f"no {path.name} in {videos}; scenes there: {', '.join(there) or 'none'}",
                wanted=f"{scene}-input, {scene}-src_spin and {scene}-<light>-gt for {', '.join(LIGHTS)}",
            )
    return [_Sequence(scene, train, inputs), _Sequence(scene, test, targets)]


def _published(videos: Path, scene: str) -> list[tuple[str, str, Path]]:
    """(method, light, video) of the renderings that are there."""
    found = []
    for ending, method in METHODS.items():
        found += [(method, light, videos / f"{scene}-{light}-{ending}.mp4") for light in LIGHTS]
    return [entry for entry in found if entry[2].is_file()]


def _read_split(cameras: Path, split: str) -> _Split:
    path = cameras / f"transforms_{split}.json"
    content = read_json(path)
    try:
        fov_radians = float(content["camera_angle_x"])
        matrices = [frame["transform_matrix"] for frame in content["frames"]]
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} is not a camera file of NeRF-synthetic",
            got=f"{type(error).__name__} {error}",
            wanted="camera_angle_x and frames with transform_matrix",
        ) from error
    poses = tuple(rigid_pose(matrix, f"frame {index} of {path}") for index, matrix in enumerate(matrices))
    return _Split(split, poses, fov_radians)


def _checked_size(videos: Sequence[tuple[Path, int]], size: int) -> int:
    """The side of all videos in pixels, after checking that they are square, of one size and of so many frames."""
    sides = set()
    for path, num_frames in videos:
        width, height = video_size(path)
        if width != height or width < size:
            raise UserError(
                "a video has the wrong size",
                got=f"{width} x {height} pixels in {path}",
                wanted=f"square, {size} pixels or more",
                fix="give a smaller --size, or the videos as published",
            )
        counted = int(imageio_ffmpeg.count_frames_and_secs(str(path))[0])
        if counted != num_frames:
            raise UserError(
                "a video and the cameras do not match",
                got=f"{counted} frames in {path}, {num_frames} cameras",
                wanted="NeRF-synthetic lego's 100 and 200 cameras, and whole videos",
            )
        sides.add(width)
    if len(sides) > 1:
        raise UserError("the videos differ in size", got=", ".join(map(str, sorted(sides))), wanted="one size")
    return sides.pop()


def _refuse_other_size(out: Path, scenes: Sequence[str], size: int) -> None:
    for scene in scenes:
        for path in (out / scene).glob("t*_*/metadata.json"):
            if read_json(path).get("imw") != size:
                raise UserError(
                    f"{out / scene} was written at another size",
                    got=f"{read_json(path).get('imw')} pixels in {path}",
                    wanted=f"{size}",
                    fix="choose another folder, or delete that one",
                )
