"""Poses from photographs alone against the poses they were rendered with; prints JSON.

    python benchmarks/own_photos.py SCENE WORK [--on-white]

SCENE is any posed folder that import-capture reads. Its images are copied without their poses, `illuminerf capture`
runs on them, and the found cameras are brought to the true ones by the best similarity of their centres. Rotation
errors are in degrees, position errors in parts of the cameras' mean distance from where they look. `up_degrees` is the
angle between the vertical that was guessed and the true one.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from illuminerf.data.capture import load_capture
from illuminerf.data.decoding import read_straight
from illuminerf.data.reading import read_source
from illuminerf.data.source import SourceCapture
from illuminerf.data.structure_from_motion import SolverConfig
from illuminerf.data.world_alignment import pose_errors, similarity_between
from illuminerf.scene.images import composite, to_uint8
from illuminerf.stages import estimate_cameras
from illuminerf.workflow.atomic import read_json


def write_without_poses(source: SourceCapture, folder: Path, on_white: bool) -> None:
    """The images alone, as <number>.png."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(source.frames):
        path = folder / f"{number:03d}.png"
        if not path.exists():
            image = read_straight(frame.image)
            shown = composite(image[..., :3], image[..., 3], 1.0) if on_white else image
            Image.fromarray(to_uint8(shown)).save(path)


def measured(source: SourceCapture, capture: Path) -> dict[str, Any]:
    """What the found poses are worth."""
    found = load_capture(capture)
    placed = [int(name) for name in found.names]
    true = np.stack([source.frames[number].world_from_camera for number in placed])
    poses = found.views.cameras.world_from_camera
    rotation, position = pose_errors(poses, true)
    turn = similarity_between(poses[:, :3, 3], true[:, :3, 3]).rotation
    report = read_json(capture / "poses.json")
    return {
        "photographs": len(source.frames),
        "placed": len(placed),
        "within_1_degree": int((rotation < 1).sum()),
        "rotation_median": round(float(np.median(rotation)), 4),
        "rotation_95": round(float(np.percentile(rotation, 95)), 4),
        "position_median": round(float(np.median(position)), 5),
        "position_95": round(float(np.percentile(position, 95)), 5),
        "up_degrees": round(float(np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))), 4),
        "attempt": report["attempt"],
        "masks": report["masks"],
        "points": report["num_points"],
        "warnings": report["warnings"],
    }


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--on-white", action="store_true", help="opaque photographs before white, no alpha")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--max-attempts", type=int, default=4)
    given = parser.parse_args()
    source = read_source(given.scene)
    write_without_poses(source, given.work / "photographs", given.on_white)
    start = time.monotonic()
    solver = SolverConfig(threads=given.threads, max_attempts=given.max_attempts)
    capture = estimate_cameras.run(
        given.work / "photographs", estimate_cameras.Config(solver=solver), given.work / "capture"
    )
    seconds = time.monotonic() - start
    print(json.dumps({"scene": given.scene.name, "seconds": round(seconds), **measured(source, capture)}, indent=2))


if __name__ == "__main__":
    main()
