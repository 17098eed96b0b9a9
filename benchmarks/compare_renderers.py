"""How far Blender's pictures of a training item are from Mitsuba's, and what each costs; prints JSON.

python benchmarks/compare_renderers.py [--size 128] [--samples 256] [--object x.glb] [--light x.exr] [--blender program]

Per picture: mean radiance of Blender's relative to Mitsuba's, less 1; PSNR between the two after sRGB; and, to tell
what of it is noise, PSNR between two of Mitsuba's with different seeds.
"""

import argparse
import json
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.cues.blender_renderer import BlenderItemRenderer
from illuminerf.cues.item_renderer import ItemRenderer, MitsubaItemRenderer, RenderedItem
from illuminerf.cues.materials import Material, Parts
from illuminerf.cues.object_files import load_object
from illuminerf.cues.renderer import CUE_NAMES, CueSampling
from illuminerf.evaluation.metrics import psnr
from illuminerf.scene.cameras import Cameras, turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.procedural import studio_light


def checkered_torus(metallic: float, steps: int = 96) -> Parts:
    """A torus with a checkered texture of two colours and two roughnesses."""
    around, across = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * steps + 1), np.linspace(0, 2 * np.pi, steps + 1))
    normals = np.stack([np.cos(across) * np.cos(around), np.cos(across) * np.sin(around), np.sin(across)], -1)
    ring = np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], -1)
    vertices = 0.62 * ring + 0.34 * normals
    uv = np.stack([around, across], -1) / (2 * np.pi)
    index = np.arange(around.size).reshape(around.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    row, column = np.indices((128, 256))
    is_red = (row // 16 + column // 16) % 2 == 1
    color = np.where(is_red[..., None], [0.75, 0.2, 0.1], [0.15, 0.35, 0.7]).astype(np.float32)
    roughness = np.where(is_red, 0.25, 0.6).astype(np.float32)
    flat = [array.reshape(-1, array.shape[-1]).astype(np.float32) for array in (vertices, normals, uv)]
    mesh = TriangleMesh(flat[0], faces.astype(np.int32), flat[1])
    return [(mesh, Material(color, roughness, metallic, flat[2]))]


def layers(item: RenderedItem) -> dict[str, np.ndarray]:
    """Pictures of the first light, [height, width, 3] by name."""
    cues = {name: item.cues[0, 3 * i : 3 * i + 3] for i, name in enumerate(CUE_NAMES)}
    return {name: image.transpose(1, 2, 0) for name, image in {**cues, "target": item.targets[0]}.items()}


def timed(
    renderer: ItemRenderer, parts: Parts, camera: Cameras, light: EnvironmentMap, seed: int
) -> tuple[RenderedItem, float]:
    """A rendered item and its seconds."""
    start = time.perf_counter()
    return renderer.render(parts, camera, [light], seed), time.perf_counter() - start


def compared(image: np.ndarray, reference: np.ndarray, other_seed: np.ndarray) -> dict[str, float]:
    """The row of one picture."""
    coded, wanted, noisy = (srgb_from_linear(np.clip(x, 0, 1)) for x in (image, reference, other_seed))
    return {
        "relative_mean_radiance": round(float(image.mean() / reference.mean() - 1), 4),
        "psnr": round(psnr(coded, wanted), 2),
        "psnr_of_mitsuba_with_another_seed": round(psnr(noisy, wanted), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--samples", type=int, default=256, help="paths per pixel of targets and cues")
    parser.add_argument("--specular-depth", type=int, default=CueSampling().specular_depth)
    parser.add_argument("--object", type=Path, help="a textured .glb; default a checkered torus")
    parser.add_argument("--metallic", type=float, default=0.0, help="of the checkered torus")
    parser.add_argument("--light", type=Path, help="an environment map; default a made-up studio")
    parser.add_argument("--blender", default="", help="a blender program or a Python that has bpy")
    options = parser.parse_args()
    generator = np.random.default_rng(0)
    parts = load_object(options.object, generator) if options.object else checkered_torus(options.metallic)
    light = EnvironmentMap.load(options.light) if options.light else studio_light(256)
    camera = turntable_cameras(1, 3.2, 0.7, options.size, options.size)
    sampling = CueSampling(options.samples, specular_depth=options.specular_depth, device="cpu")
    mitsuba = MitsubaItemRenderer(options.samples, sampling, bakes_textures=False)
    blender = BlenderItemRenderer(options.samples, sampling, options.blender, bakes_properties=False)
    other_seed, first_seconds = timed(mitsuba, parts, camera, light, 1)
    reference, mitsuba_seconds = timed(mitsuba, parts, camera, light, 0)
    item, blender_seconds = timed(blender, parts, camera, light, 0)
    pictures, wanted, noisy = layers(item), layers(reference), layers(other_seed)
    report: dict[str, Any] = {
        "object": options.object.stem if options.object else f"checkered torus, metallic {options.metallic:g}",
        "light": light.name,
        "size": options.size,
        "samples_per_pixel": options.samples,
        "specular_depth": options.specular_depth,
        "faces": sum(len(mesh.faces) for mesh, _ in parts),
        "pictures": {name: compared(image, wanted[name], noisy[name]) for name, image in pictures.items()},
        "largest_difference_of_coverage": round(float(np.abs(item.alpha - reference.alpha).max()), 4),
        "seconds": {
            "mitsuba_first_item": round(first_seconds, 2),
            "mitsuba": round(mitsuba_seconds, 2),
            "blender": round(blender_seconds, 2),
        },
        "processor": platform.processor() or platform.machine(),
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
