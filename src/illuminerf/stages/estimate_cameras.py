"""Photographs or a video -> Capture, with a page to check it by.

Masks are settled, poses estimated by structure from motion, the world is turned upright and brought to the unit ball,
and the photographs are undistorted and cut out. What could not be placed is left out and named.

capture.json, cameras.json, images/<000>.png    the capture, as import_capture writes it
check.html                                      cameras in 3D, outlines over photographs, warnings
poses.json                                      per photograph: placed or not, points, error; and how it was done
"""

import dataclasses
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from illuminerf.data.capture import write_capture
from illuminerf.data.capture_page import Pictures, capture_page
from illuminerf.data.capture_warnings import Quality, warnings_of
from illuminerf.data.developing import develop, plan_sizes, planned_cameras
from illuminerf.data.matching_images import Matched, small_photograph, write_matching_images
from illuminerf.data.object_masks import Masked, MaskSource, settle_masks
from illuminerf.data.photographs import left_out, photographs_of, read_shot
from illuminerf.data.placement import Ball, focus_ball, hull_ball, mask_preview
from illuminerf.data.solved_cameras import Solved
from illuminerf.data.source import SourceCapture, SourceFrame
from illuminerf.data.structure_from_motion import SolverConfig, load_pycolmap, solve
from illuminerf.data.video_frames import sharpness
from illuminerf.data.world_alignment import Similarity, levelled, up_axis
from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.artefact import fingerprint, open_artefact
from illuminerf.workflow.atomic import check_writable, write_bytes, write_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, track

_THUMBNAIL = 220
_STANDING_STILL = 0.05
"""Spread of the camera centres, in distances to where they look, below which the surroundings were tracked and not a
turning object."""


@dataclass(frozen=True)
class Config:
    """How photographs become a capture."""

    masks: MaskSource = "auto"
    """Where masks come from; "auto" takes the first there is of the mask folder, alpha and a plain backdrop."""
    mask_folder: str = "masks"
    """Folder beside the photographs with one mask each, white on the object."""
    match: Matched | Literal["auto"] = "auto"
    """What poses are estimated from: the object alone, which a turntable needs, or everything in view. "auto" is the
    object before plain backgrounds and with alpha, else everything; where that says the camera stood still, the object.
    """
    size: int = 1600
    """Longest side of the capture's images in pixels; larger photographs are averaged down."""
    matching_size: int = 1600
    """Longest side at which features are looked for."""
    num_frames: int = 100
    """Frames taken from a video."""
    up: Literal["cameras", "first"] = "cameras"
    """Which way is up: perpendicular to the right axes of all cameras (held level), or up in the first photograph."""
    object_radius: float = 0.9
    """Radius of the object's bounding ball, in units of the unit ball."""
    solver: SolverConfig = field(default_factory=SolverConfig)
    """Of structure from motion."""

    def __post_init__(self) -> None:
        if min(self.size, self.matching_size) < 32 or self.num_frames < 3:
            raise UserError("sizes or frames are too few", wanted="32 pixels and 3 frames, or more")
        if not 0 < self.object_radius <= 1:
            raise UserError("object_radius is out of range", got=str(self.object_radius), wanted="(0, 1]")
        if self.match == "object" and self.masks == "none":
            raise UserError("the object cannot be matched alone without masks", fix="set match to everything")


def run(photographs: Path, config: Config, out: Path) -> Path:
    """Estimate the cameras of `photographs`, a folder or a video, and write the capture to `out`.

    Raises:
        UserError: before anything is written, where there are too few photographs, masks are missing, or poses cannot
            be estimated.
    """
    load_pycolmap()
    with tempfile.TemporaryDirectory(prefix="illuminerf_") as temporary:
        work = Path(temporary)
        inputs: dict[str, Path | str] = {"photographs": _digest(photographs, config)}
        if (out / "DONE").exists():
            with open_artefact(out, "estimate_cameras", config, inputs):
                return out
        check_writable(out)
        frames = photographs_of(photographs, config.mask_folder, config.num_frames, work / "frames")
        if refused := left_out(photographs):
            say(f"left out, for they are not read: {len(refused)} files such as {refused[0]}; export them as JPEG")
        masked = settle_masks(frames, config.masks, work / "cut")
        solved, matched = _solve(masked, config, work)
        upright = _upright(solved, config)
        posed = [_posed(masked.frames[index], solved, index, upright, config) for index in solved.cameras]
        source = SourceCapture(photographs, tuple(posed), shares_intrinsics=False)
        plan = plan_sizes(source, config.size)
        cameras = planned_cameras(source, plan)
        images = [
            develop(frame, size, plan.common, masked.backdrop)
            for frame, size in zip(track(posed, "undistort and cut out"), plan.per_frame, strict=True)
        ]
        scale, offset = _ball(cameras, images, masked).placement(config.object_radius)
        placed = cameras.transformed(scale, offset)
        points = (upright.points(solved.points) + offset) * scale
        small = [small_photograph(masked.frames[index], masked, _THUMBNAIL) for index in solved.cameras]
        quality = _quality(masked, solved, placed, small)
        warnings = warnings_of(quality)
        notes = [_lens_note(solved), f"Masks: {masked.source}. Poses from {matched}, {solved.attempt}."]
        page = capture_page(photographs.stem, quality, warnings, notes, Pictures(small, placed, points, solved.colours))
        with open_artefact(out, "estimate_cameras", config, inputs) as artefact:
            straight = (image / 255.0 for image in images)
            background: Literal["masked", "opaque"] = "opaque" if masked.source == "none" else "masked"
            write_capture(out, straight, placed, quality.names, scale, offset, background)
            write_bytes(out / "check.html", page)
            write_json(out / "poses.json", _report(quality, solved, masked, matched, warnings))
            artefact.finish({"views": len(posed), "photographs": len(frames)})
    for text in warnings:
        say(f"look: {text}")
    say(f"check the poses and masks before going on: {out / 'check.html'}")
    return out


def _digest(photographs: Path, config: Config) -> str:
    """Of the files that are read: the video, or photographs and masks."""
    if not photographs.is_dir():
        return fingerprint(photographs) if photographs.exists() else ""
    frames = photographs_of(photographs, config.mask_folder, config.num_frames, photographs)
    files = [path for frame in frames for path in (frame.image, frame.mask) if path]
    return "\n".join(f"{path.relative_to(photographs)} {fingerprint(path)}" for path in files)


def _solve(masked: Masked, config: Config, work: Path) -> tuple[Solved, Matched]:
    """Poses, and what they were estimated from."""
    matched: Matched = "object" if masked.source in ("alpha", "plain") else "everything"
    if config.match != "auto":
        matched = config.match
    solved = _solve_once(masked, matched, config, work)
    if config.match == "auto" and matched == "everything" and masked.source != "none" and _stands_still(solved):
        say("the surroundings say that the camera stood still: the object turned, so poses come from it alone")
        matched = "object"
        solved = _solve_once(masked, matched, config, work)
    return solved, matched


def _solve_once(masked: Masked, matched: Matched, config: Config, work: Path) -> Solved:
    folder = work / matched
    images = write_matching_images(masked, matched, config.matching_size, folder)
    return solve(images, folder, config.solver)


def _stands_still(solved: Solved) -> bool:
    centres = np.stack([camera.world_from_camera[:3, 3] for camera in solved.cameras.values()])
    if not len(solved.points):
        return True
    distance = np.linalg.norm(np.median(solved.points, axis=0) - centres, axis=-1).mean()
    spread = np.linalg.norm(centres - centres.mean(0), axis=-1).mean()
    return bool(spread < _STANDING_STILL * distance)


def _upright(solved: Solved, config: Config) -> Similarity:
    poses = np.stack([camera.world_from_camera for camera in solved.cameras.values()])
    up = up_axis(poses) if config.up == "cameras" else poses[0, :3, 1]
    cameras = Cameras(poses, np.array([camera.intrinsics for camera in solved.cameras.values()]), 1, 1)
    return levelled(cameras, up, np.median(solved.points, axis=0))


def _posed(frame: SourceFrame, solved: Solved, index: int, upright: Similarity, config: Config) -> SourceFrame:
    """The frame with its pose in the upright world and the intrinsics of its own size."""
    found, camera = solved.cameras[index], frame.camera
    shrink = min(1.0, config.matching_size / max(camera.width, camera.height))
    to_x = camera.width / max(1, round(camera.width * shrink))
    to_y = camera.height / max(1, round(camera.height * shrink))
    fx, fy, cx, cy = found.intrinsics
    full = dataclasses.replace(
        camera, fx=fx * to_x, fy=fy * to_y, cx=cx * to_x, cy=cy * to_y, distortion=found.distortion
    )
    return dataclasses.replace(frame, camera=full, world_from_camera=upright.poses(found.world_from_camera[None])[0])


def _ball(cameras: Cameras, images: list[np.ndarray], masked: Masked) -> Ball:
    if masked.source == "none":
        return focus_ball(cameras)
    return hull_ball(cameras, [mask_preview(image[..., 3] > 127) for image in images])


def _quality(masked: Masked, solved: Solved, placed: Cameras, small: list[np.ndarray]) -> Quality:
    frames = [masked.frames[index] for index in solved.cameras]
    x, y, z = placed.positions.T
    border = [np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]]) for alpha in _alphas(small)]
    exposures = (read_shot(frame.image).exposure for frame in frames)
    found = list(solved.cameras.values())
    sides = [max(2 * camera.intrinsics[2], 2 * camera.intrinsics[3]) for camera in found]
    return Quality(
        num_photographs=len(masked.frames),
        unplaced=tuple(frame.name for index, frame in enumerate(masked.frames) if index not in solved.cameras),
        names=tuple(frame.name for frame in frames),
        azimuths=np.degrees(np.arctan2(y, x)),
        elevations=np.degrees(np.arctan2(z, np.hypot(x, y))),
        errors=np.array([camera.error for camera in found]),
        num_points=np.array([camera.num_points for camera in found]),
        sharpness=np.array([sharpness(image[..., :3].mean(-1)) for image in small]),
        object_shares=np.array([(alpha > 127).mean() for alpha in _alphas(small)]),
        border_shares=np.array([(ring > 127).mean() for ring in border]),
        exposures=tuple(exposure for exposure in exposures if exposure),
        focal=float(np.mean([camera.intrinsics[0] / side for camera, side in zip(found, sides, strict=True)])),
        has_masks=masked.source != "none",
    )


def _alphas(images: list[np.ndarray]) -> list[np.ndarray]:
    return [image[..., 3] for image in images]


def _lens_note(solved: Solved) -> str:
    camera = next(iter(solved.cameras.values()))
    return f"Focal length {camera.intrinsics[0]:.0f} pixels, distortion k1 {camera.distortion[0]:+.4f}."


def _report(quality: Quality, solved: Solved, masked: Masked, matched: Matched, warnings: list[str]) -> dict[str, Any]:
    rows = zip(quality.names, quality.num_points.tolist(), quality.errors.tolist(), strict=True)
    return {
        "attempt": solved.attempt,
        "masks": masked.source,
        "matched": matched,
        "num_points": len(solved.points),
        "placed": [
            {"name": name, "points": points, "error_pixels": round(error, 4) if np.isfinite(error) else None}
            for name, points, error in rows
        ],
        "not_placed": list(quality.unplaced),
        "warnings": warnings,
    }
