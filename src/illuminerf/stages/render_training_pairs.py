"""Objects x views x lights -> the pairs a relighting model learns from (paper, 3.3 and supplement).

One file per view holds the object under several lights with the radiance cues of each: from k lights come k * (k - 1)
ordered pairs. Files are `items/<object>_<view>.safetensors`:
    targets    float16 [lights, 3, height, width]   linear, premultiplied
    cues       float16 [lights, 12, height, width]  linear, premultiplied, channels as `CUE_CHANNELS`
    alpha      uint8 [height, width]
    albedo     uint8 [3, height, width]             base colour, sRGB coded, straight
    roughness, metallic  uint8 [height, width]      times 255, straight
    normal     float16 [3, height, width]           unit, world frame, towards the camera; 0 off the object
and JSON metadata: object, view, split, lights (name, rotation_radians, is_flipped, scale), camera, coverage.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from illuminerf.cues.item_renderer import MitsubaItemRenderer, RenderedItem
from illuminerf.cues.object_files import load_object
from illuminerf.cues.renderer import CueSampling
from illuminerf.cues.training_lights import draw_light
from illuminerf.cues.variations import varied
from illuminerf.scene.cameras import Cameras, sphere_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.checkpoint import save_checkpoint
from illuminerf.workflow.config import to_json
from illuminerf.workflow.device import derived_seed, numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, step_progress

STAGE = "render_training_pairs"
_LIGHT_HEIGHT = 256
_HALF_MAX = 65504.0


@dataclass(frozen=True)
class Config:
    """What is rendered, and how well."""

    num_views: int = 4
    """Cameras per object (paper: 4)."""
    num_lights: int = 4
    """Lights per view (paper's main text: 4)."""
    size: int = 128
    """Height and width in pixels (paper: 512)."""
    samples_per_pixel: int = 16
    """Paths per pixel of the targets. Deviation: 512 in the paper; the model averages what noise is left."""
    cue_sampling: CueSampling = field(default_factory=lambda: CueSampling(samples_per_pixel=16))
    """Paths and bounces of the cues."""
    min_distance: float = 2.6
    """Nearest camera, in radii of the object."""
    max_distance: float = 3.8
    """Farthest camera; the field of view follows, so that the object always fills the picture.
    Deviation: the paper's focal length is 512 pixels at 512 x 512, whatever the distance."""
    margin: float = 1.06
    """Half the picture over the object's farthest point from its centre."""
    min_elevation_radians: float = -0.4
    """Lowest camera. Deviation: the paper takes the whole sphere; captures are seldom made from below."""
    flip_probability: float = 0.5
    """How often a light is turned upside down."""
    vary_probability: float = 0.5
    """How often an item's materials are replaced at random (see `variations.varied`).
    Deviation: not in the paper, which has 150,000 objects where small collections have a hundred."""
    bakes_textures: bool = True
    """Move textures onto vertices, which saves compiling kernels; turn off above 128 pixels."""
    excluded: tuple[str, ...] = ()
    """Objects to leave out by name, for reasons seen by eye."""
    split: str = "train"
    """Written into each item's metadata."""
    seed: int = 0
    """Seed of every random choice, joined with the item's name."""

    def __post_init__(self) -> None:
        if min(self.num_views, self.size, self.samples_per_pixel) < 1 or self.num_lights < 2:
            raise UserError("training pairs need at least one view, one sample and two lights")
        if not 1 < self.min_distance <= self.max_distance:
            raise UserError("camera distances must be over 1 and in order")
        if not (0 <= self.flip_probability <= 1 and 0 <= self.vary_probability <= 1):
            raise UserError("probabilities must lie in [0, 1]")


def run(models: Path, lights: Path, config: Config, out: Path) -> Path:
    """Render every view of every object in `models` under lights of `lights` into `out`; broken objects are named in
    `manifest.json` with the reason, and never replaced by others.

    Args:
        models: a folder of .glb files.
        lights: a folder of .exr or .hdr environment maps.
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: there are no objects, or too few lights.
    """
    objects = sorted(models.glob("*.glb"))
    if not objects:
        raise UserError(f"{models} holds no objects", wanted=".glb files")
    maps = _load_lights(lights, config.num_lights)
    with open_artefact(out, STAGE, config, {"models": models, "lights": lights}) as artefact:
        if artefact.is_done:
            return out
        quarantined = {name: "excluded by name" for name in config.excluded}
        total = len(objects) * config.num_views
        with step_progress("render training pairs", total) as progress:
            # every object once before any object twice, so that training may start on a part
            for path, view in _in_rounds(objects, config.num_views):
                item = out / "items" / f"{path.stem}_{view}.safetensors"
                if path.stem not in quarantined and not item.exists():
                    reason = _render_item(path, view, maps, config, item)
                    if reason:
                        quarantined[path.stem] = reason
                        say(f"quarantined {path.stem}: {reason}")
                progress.advance(quarantined=float(len(quarantined)))
        items = sorted(item.stem for item in (out / "items").glob("*.safetensors"))
        write_json(out / "manifest.json", {"items": items, "quarantined": dict(sorted(quarantined.items()))})
        artefact.finish({"num_items": len(items), "num_quarantined": len(quarantined)})
    return out


def _in_rounds(objects: list[Path], num_views: int) -> Iterator[tuple[Path, int]]:
    for view in range(num_views):
        for path in objects:
            yield path, view


def _load_lights(folder: Path, wanted: int) -> list[EnvironmentMap]:
    paths = sorted([*folder.glob("*.exr"), *folder.glob("*.hdr")])
    if len(paths) < wanted:
        raise UserError(f"{folder} holds too few lights", got=str(len(paths)), wanted=f"{wanted} .exr or .hdr maps")
    return [_at_height(EnvironmentMap.load(path)) for path in paths]


def _at_height(light: EnvironmentMap) -> EnvironmentMap:
    """All lights of one scene have one resolution; larger maps are averaged, smaller ones repeated."""
    height = light.linear_rgb.shape[0]
    if height > _LIGHT_HEIGHT:
        return light.resized(_LIGHT_HEIGHT)
    if _LIGHT_HEIGHT % height:
        raise UserError(f"the light '{light.name}' has an odd size", got=f"{height} rows", wanted="a power of two")
    factor = _LIGHT_HEIGHT // height
    return EnvironmentMap(light.linear_rgb.repeat(factor, 0).repeat(factor, 1), light.name)


def item_camera(config: Config, vertices: np.ndarray, generator: np.random.Generator) -> Cameras:
    """One camera on a sphere about an object, whose field of view the object just fills.

    Args:
        config: distances, elevations, size.
        vertices: the object's points [vertices, 3], in the unit sphere.
        generator: draws distance and direction.
    """
    distance = float(generator.uniform(config.min_distance, config.max_distance))
    size, low = config.size, config.min_elevation_radians
    camera = sphere_cameras(1, distance, np.pi / 2, size, size, generator, min_elevation_radians=low)
    points, _ = camera.project(vertices)
    tangent = np.abs(points[0] / (size / 2) - 1).max()
    intrinsics = camera.intrinsics.copy()
    intrinsics[:, :2] = size / 2 / (tangent * config.margin)
    return Cameras(camera.world_from_camera, intrinsics, size, size)


def _render_item(path: Path, view: int, maps: list[EnvironmentMap], config: Config, item: Path) -> str | None:
    """Render and write one item; the reason where the object is broken."""
    generator = numpy_generator(config.seed, "item", path.stem, view)
    try:
        parts = load_object(path, numpy_generator(config.seed, "object", path.stem))
    except UserError as error:
        return str(error)
    if generator.random() < config.vary_probability:
        parts = varied(parts, generator)
    vertices = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh, _ in parts])
    camera = item_camera(config, vertices, generator)
    chosen = generator.choice(len(maps), config.num_lights, replace=False)
    draws = [draw_light(maps[index], generator, config.flip_probability) for index in chosen]
    seed = derived_seed(config.seed, "render", path.stem, view)
    renderer = MitsubaItemRenderer(config.samples_per_pixel, config.cue_sampling, config.bakes_textures)
    rendered = renderer.render(parts, camera, [light for light, _ in draws], seed)
    coverage = float(rendered.alpha.mean())
    if coverage == 0:
        return "nothing to be seen in a view"
    metadata = {
        "object": path.stem,
        "view": view,
        "split": config.split,
        "lights": [to_json(draw) for _, draw in draws],
        "camera": camera.to_dict(),
        "coverage": coverage,
    }
    save_checkpoint(item, _tensors(rendered), metadata)
    return None


def _tensors(item: RenderedItem) -> dict[str, torch.Tensor]:
    return {
        "targets": _half(item.targets),
        "cues": _half(item.cues),
        "alpha": _byte(item.alpha),
        "albedo": _byte(srgb_from_linear(item.base_color)),
        "roughness": _byte(item.roughness),
        "metallic": _byte(item.metallic),
        "normal": _half(item.normal),
    }


def _half(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.clip(array, -_HALF_MAX, _HALF_MAX))).half()


def _byte(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.rint(np.clip(array, 0, 1) * 255))).to(torch.uint8)
