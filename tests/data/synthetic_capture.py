"""A small capture with known pixels and poses, and writers of every format the importer reads."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from illuminerf.scene.cameras import Cameras, sphere_cameras
from illuminerf.scene.images import linear_from_srgb, write_exr

FOV = 0.7
CENTRE = np.array([0.4, -0.3, 1.1])
RADIUS = 0.5


def ball_cameras(num_views: int = 8, height: int = 40, width: int = 48) -> Cameras:
    """Cameras 3 units around CENTRE that look at it."""
    cameras = sphere_cameras(num_views, 3.0, FOV, height, width, np.random.default_rng(0))
    return cameras.transformed(1.0, CENTRE)


def ball_images(cameras: Cameras) -> np.ndarray:
    """uint8 [views, height, width, 4]: a ball about CENTRE, coloured by direction, alpha binary, black
    outside.
    """
    images = []
    for view in range(len(cameras)):
        origins, directions = (values.double().numpy() for values in cameras.image_rays(view))
        to_centre = CENTRE - origins
        along = np.sum(to_centre * directions, -1)
        gap = np.linalg.norm(to_centre, axis=-1) ** 2 - along**2
        hit = gap < RADIUS**2
        depth = along - np.sqrt(np.maximum(RADIUS**2 - gap, 0))
        normals = (origins + depth[..., None] * directions - CENTRE) / RADIUS
        colour = np.clip(0.5 + 0.4 * normals, 0, 1)
        image = np.concatenate([colour, np.ones_like(colour[..., :1])], -1) * hit[..., None]
        images.append(np.round(image * 255).astype(np.uint8))
    return np.stack(images)


def write_transforms(
    root: Path,
    cameras: Cameras,
    images: np.ndarray,
    name: str = "transforms.json",
    per_frame: bool = False,
    with_masks: bool = False,
    mask_path: bool = False,
    extra: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """transforms.json and images/; RGBA, or RGB with a folder of masks. Returns the JSON."""
    (root / "images").mkdir(parents=True)
    frames = []
    for view, image in enumerate(images):
        frame: dict[str, Any] = {"file_path": f"images/{view:02d}.png"}
        frame["transform_matrix"] = cameras.world_from_camera[view].tolist()
        if with_masks or mask_path:
            folder = "cutouts" if mask_path else "masks"
            (root / folder).mkdir(exist_ok=True)
            Image.fromarray(image[..., :3]).save(root / frame["file_path"])
            Image.fromarray(image[..., 3]).save(root / folder / f"{view:02d}.png")
            frame |= {"mask_path": f"cutouts/{view:02d}.png"} if mask_path else {}
        else:
            Image.fromarray(image).save(root / frame["file_path"])
        if per_frame:
            frame |= _intrinsics(cameras, view)
        frames.append(frame)
    content = {"frames": frames, **(extra or {}), **({} if per_frame else _intrinsics(cameras, 0))}
    (root / name).write_text(json.dumps(content))
    return content


def _intrinsics(cameras: Cameras, view: int) -> dict[str, float]:
    names = ("fl_x", "fl_y", "cx", "cy")
    values = cameras.intrinsics[view].tolist()
    return {**dict(zip(names, values, strict=True)), "w": cameras.width, "h": cameras.height}


def write_nerf_synthetic(root: Path, cameras: Cameras, images: np.ndarray) -> None:
    """transforms_train.json with camera_angle_x, and names without a suffix."""
    (root / "train").mkdir(parents=True)
    frames = []
    for view, image in enumerate(images):
        Image.fromarray(image).save(root / "train" / f"r_{view}.png")
        pose = cameras.world_from_camera[view].tolist()
        frames.append({"file_path": f"./train/r_{view}", "rotation": 0.1, "transform_matrix": pose})
    content = {"camera_angle_x": FOV, "frames": frames}
    (root / "transforms_train.json").write_text(json.dumps(content))


def write_tensoir(root: Path, cameras: Cameras, images: np.ndarray, light: str = "sunset") -> None:
    """The benchmark's layout."""
    for view, image in enumerate(images):
        folder = root / f"train_{view:03d}"
        folder.mkdir(parents=True)
        Image.fromarray(image).save(folder / f"rgba_{light}.png")
        pose = ",".join(repr(value) for value in cameras.world_from_camera[view].ravel().tolist())
        size = {"imw": cameras.width, "imh": cameras.height}
        (folder / "metadata.json").write_text(json.dumps({"cam_transform_mat": pose, "cam_angle_x": FOV, **size}))


def write_plain(root: Path, cameras: Cameras, images: np.ndarray, with_masks: bool = False) -> None:
    """images/, cameras.json and, on demand, masks/."""
    (root / "images").mkdir(parents=True)
    (root / "cameras.json").write_text(json.dumps(cameras.to_dict()))
    for view, image in enumerate(images):
        if with_masks:
            (root / "masks").mkdir(exist_ok=True)
            Image.fromarray(image[..., 3]).save(root / "masks" / f"{view}.png")
        Image.fromarray(image[..., :3] if with_masks else image).save(root / "images" / f"{view}.png")


def write_plain_exr(root: Path, cameras: Cameras, images: np.ndarray) -> None:
    """images/*.exr, linear and premultiplied."""
    (root / "cameras.json").parent.mkdir(parents=True)
    (root / "cameras.json").write_text(json.dumps(cameras.to_dict()))
    for view, image in enumerate(images):
        values = image.astype(np.float32) / 255
        linear = linear_from_srgb(values[..., :3]) * values[..., 3:]
        channels = {name: linear[..., i] for i, name in enumerate("RGB")} | {"A": values[..., 3]}
        write_exr(root / "images" / f"{view}.exr", channels, half=False)
