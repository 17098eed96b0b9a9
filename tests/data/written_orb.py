"""Stanford-ORB's layout with random pictures: two objects under two lights each, written in a moment."""

import atexit
import functools
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np

from illuminerf.scene.cameras import sphere_cameras
from illuminerf.scene.images import srgb_from_linear, write_png, write_rgb_exr

CAPTURES = ("cup_scene001", "cup_scene002", "duck_scene001", "duck_scene003")
NAMES = ("0003", "0011")
FOV = 0.6


def write_orb(root: Path) -> Path:
    """Every capture has three photographs of 24 x 24 pixels to learn from and the test views NAMES."""
    shutil.copytree(_template(), root)
    return root


@functools.cache
def _template() -> Path:
    """Written once: every file is synced to the disk."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return _written(folder, 24)


def _written(root: Path, size: int) -> Path:
    generator = np.random.default_rng(0)
    mask = np.zeros((size, size, 1), np.float32)
    mask[size // 6 : -size // 6, size // 6 : -size // 6] = 1
    for capture in CAPTURES:
        poses = sphere_cameras(3 + len(NAMES), 3.0, FOV, size, size, generator).world_from_camera
        for kind in ("HDR", "LDR"):
            folder = root / f"blender_{kind}" / capture
            folder.mkdir(parents=True)
            frames = {"train": [f"train/{view:04d}" for view in range(3)], "test": [f"test/{name}" for name in NAMES]}
            for split, chosen in (("train", poses[:3]), ("test", poses[3:])):
                entries = [
                    {"file_path": name, "transform_matrix": pose.tolist()}
                    for name, pose in zip(frames[split], chosen, strict=True)
                ]
                content = {"camera_angle_x": FOV, "frames": entries}
                (folder / f"transforms_{split}.json").write_text(json.dumps(content))
                for name in frames[split]:
                    write_png(folder / f"{split}_mask" / f"{Path(name).name}.png", mask[..., 0])
        other = next(name for name in CAPTURES if name != capture and name[:3] == capture[:3])
        for kind, poses_of_other in (("HDR", poses[3:]), ("LDR", poses[3:])):
            frames_of_other = [
                {"scene_name": other, "file_path": f"test/{name}", "camera_angle_x": FOV + 0.01 * index,
                 "transform_matrix": pose.tolist()}
                for index, (name, pose) in enumerate(zip(NAMES, poses_of_other, strict=True))
            ]  # fmt: skip
            path = root / f"blender_{kind}" / capture / "transforms_novel.json"
            path.write_text(json.dumps({"frames": frames_of_other}))
        for name in [*(f"train/{view:04d}" for view in range(3)), *(f"test/{name}" for name in NAMES)]:
            image = generator.uniform(0.02, 0.9, (size, size, 3)).astype(np.float32)
            write_rgb_exr(root / "blender_HDR" / capture / f"{name}.exr", image, half=False)
            write_png(root / "blender_LDR" / capture / f"{name}.png", srgb_from_linear(image))
        for name in NAMES:
            light = generator.uniform(0, 1, (8, 16, 3)).astype(np.float32)
            write_rgb_exr(root / "ground_truth" / capture / "env_map" / f"{name}.exr", light, half=False)
    return root
