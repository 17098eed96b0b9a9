"""What Blender is asked to render, as files: a folder with arrays, pictures and one JSON list of renderings.

    job.json        camera, parts, lights, renderings, settings
    meshes.npz      vertices_0 [V, 3], normals_0 [V, 3], faces_0 [F, 3] and, where the part has them, uv_0 [V, 2],
                    base_color_0 [V, 3], roughness_0 [V], metallic_0 [V]; then part 1, ...
    texture_0.exr, surface_0.exr      of a textured part: linear base colour; R roughness, G metallic
    light_0.exr, ...                  equirectangular linear radiance
    <rendering>.exr                   written by Blender: linear premultiplied RGBA, 32 bits

Nothing in it is pickled. `blender_worker` reads it with numpy alone.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.cues.materials import Material, Parts
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_exr, write_rgb_exr
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.errors import UserError

_LARGEST_SEED = 2**31 - 1


@dataclass(frozen=True)
class Rendering:
    """One picture of the item."""

    name: str
    """Its file is <name>.exr."""
    material: str
    """own, diffuse or glossy."""
    light: int
    """Index of the light."""
    samples: int
    """Paths per pixel."""
    depth: int
    """Longest path in edges, as `CueSampling` counts: 2 is direct light."""
    seed: int
    """Any number; Blender knows 2^31 of them."""
    roughness: float = 0.0
    """Blender's roughness r (alpha = r * r) of the glossy material."""


def write_job(
    folder: Path,
    parts: Parts,
    camera: Cameras,
    lights: list[EnvironmentMap],
    renderings: list[Rendering],
    denoises: bool = False,
    device: str = "auto",
) -> None:
    """Write all that Blender needs into a folder.

    Args:
        folder: an empty folder.
        parts: meshes with materials, in the world of the camera.
        camera: its first view is rendered.
        lights: linear radiance in our axes, which are Blender's.
        renderings: what to render, in this order.
        denoises: let OpenImageDenoise work on every picture.
        device: auto and cpu render on the processor, cuda on a graphics card.
    """
    arrays: dict[str, np.ndarray] = {}
    materials = []
    for index, (mesh, material) in enumerate(parts):
        arrays[f"vertices_{index}"] = np.ascontiguousarray(mesh.vertices, np.float32)
        arrays[f"normals_{index}"] = np.ascontiguousarray(mesh.vertex_normals, np.float32)
        arrays[f"faces_{index}"] = np.ascontiguousarray(mesh.faces, np.int32)
        materials.append(_write_material(folder, index, material, arrays))
    np.savez(folder / "meshes.npz", **arrays)  # type: ignore[arg-type]
    for index, light in enumerate(lights):
        light.save(folder / f"light_{index}.exr")
    write_json(
        folder / "job.json",
        {
            "camera": _camera(camera),
            "materials": materials,
            "num_lights": len(lights),
            "renderings": [_to_json(rendering) for rendering in renderings],
            "denoises": denoises,
            "device": device,
        },
    )


def read_rendering(folder: Path, name: str, camera: Cameras) -> np.ndarray:
    """One finished picture: float32 [height, width, 4], linear premultiplied radiance and coverage.

    Raises:
        UserError: it is missing, unreadable or of another size.
    """
    channels = read_exr(folder / f"{name}.exr")
    if not {"R", "G", "B", "A"} <= channels.keys():
        raise UserError("Blender wrote a picture without colour or coverage", got=", ".join(channels))
    image = np.stack([channels[c] for c in "RGBA"], -1).astype(np.float32)
    if image.shape[:2] != (camera.height, camera.width):
        raise UserError(
            "Blender wrote a picture of another size",
            got=f"{image.shape[1]} x {image.shape[0]}",
            wanted=f"{camera.width} x {camera.height}",
        )
    # a path of zero probability can give a NaN in single precision; it carries no light
    return np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0)


def _to_json(rendering: Rendering) -> dict[str, Any]:
    content = asdict(rendering)
    # Mitsuba counts edges of a path, Blender the bounces after the first surface: 2 edges are direct light, 0 bounces
    content["bounces"] = content.pop("depth") - 2
    content["seed"] = rendering.seed % _LARGEST_SEED
    return content


def _camera(camera: Cameras) -> dict[str, Any]:
    fx, fy, cx, cy = camera.intrinsics[0]
    width, height = camera.width, camera.height
    pixel_aspect = fx / fy  # height of a pixel in widths
    return {
        "world_from_camera": camera.world_from_camera[0].tolist(),
        "width": width,
        "height": height,
        "focal_in_widths": fx / width,
        "pixel_aspect": pixel_aspect,
        # in widths of the picture, whichever the axis; moving the film up moves the axis down in the picture
        "shift_x": 0.5 - cx / width,
        "shift_y": (cy - height / 2) * pixel_aspect / width,
    }


def _write_material(folder: Path, index: int, material: Material, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Texture files, arrays per vertex, or numbers; returns which of them, and the numbers."""
    if material.is_textured:
        assert material.uv is not None
        color, roughness, metallic = material.images()
        write_rgb_exr(folder / f"texture_{index}.exr", color, half=False)
        surface = np.concatenate([roughness, metallic, np.zeros_like(metallic)], -1)
        write_rgb_exr(folder / f"surface_{index}.exr", np.ascontiguousarray(surface, np.float32), half=False)
        arrays[f"uv_{index}"] = np.ascontiguousarray(material.uv, np.float32)
        return {"kind": "textured"}
    values = {"base_color": material.base_color, "roughness": material.roughness, "metallic": material.metallic}
    constant = {"base_color": 1, "roughness": 0, "metallic": 0}
    if any(np.asarray(value).ndim != constant[name] for name, value in values.items()):
        num_vertices = len(arrays[f"vertices_{index}"])
        for name, value in zip(values, material.per_vertex(num_vertices), strict=True):
            arrays[f"{name}_{index}"] = np.ascontiguousarray(value, np.float32)
        return {"kind": "per_vertex"}
    mix = float(material.metallic)
    return {
        # objects without any material are given a mix of lobes; of others hardly one is half a metal all over
        "kind": "mix" if 0 < mix < 1 else "constant",
        **{name: np.asarray(value, np.float32).tolist() for name, value in values.items()},
    }
