"""A known object + cameras + a light for each -> renderings that a relighting can be compared with.

linear/<000>.exr      linear radiance, premultiplied, and A
cameras.json          the views

For the paper's study of illumination (supplement, "Stanford-ORB Illumination Issues"): scanned objects under one light
for all views, and under the light that was measured for each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from illuminerf.cues.object_files import OBJECT_SUFFIXES, ObjectReading, load_object_in_place
from illuminerf.cues.raw_objects import ReadingLimits
from illuminerf.cues.shading import ShadedScene
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import write_exr
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.device import derived_seed, numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

_READING = ObjectReading(limits=ReadingLimits(max_faces=20_000_000, max_texture_side=4096))
"""Scans are finer than what is trained on."""


@dataclass(frozen=True)
class Config:
    """How references are path traced."""

    samples_per_pixel: int = 128
    """Paths per pixel."""
    max_light_height: int = 512
    """Rows; larger lights are averaged down."""
    device: str = "auto"
    """auto, cpu or cuda."""
    seed: int = 0
    """Each view's seed is derived from it."""

    def __post_init__(self) -> None:
        if min(self.samples_per_pixel, self.max_light_height) < 1:
            raise UserError("references need at least one sample per pixel and one row of light")


def run(object_folder: Path, cameras_path: Path, lights: Sequence[Path], config: Config, out: Path) -> Path:
    """Render the object in `object_folder` from every camera; views that exist are kept.

    Args:
        object_folder: holds one .obj, .glb, .gltf or .ply file, in the world of the cameras, and its textures.
        cameras_path: a cameras.json.
        lights: environment maps in that world, one for all views or one for each.
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: the object, a camera or a light is missing or unusable.
    """
    path = object_file(object_folder)
    cameras = Cameras.from_dict(read_json(cameras_path))
    if len(lights) not in (1, len(cameras)):
        raise UserError("views and lights do not match", got=f"{len(lights)} lights", wanted=f"1 or {len(cameras)}")
    inputs: dict[str, Path | str] = {"object": object_folder, "cameras": cameras_path}
    inputs |= {f"light_{index:03d}": light for index, light in enumerate(lights)}
    with open_artefact(out, "render_reference_views", config, inputs) as artefact:
        if artefact.is_done:
            return out
        parts = load_object_in_place(path, numpy_generator(config.seed, "missing materials"), _READING)
        first = _light(lights[0], config, None)
        scene = ShadedScene(parts, first, config.device)
        light = first
        for view in track(range(len(cameras)), "render references"):
            if reference_path(out, view).exists():
                continue
            if len(lights) > 1:
                light = _light(lights[view], config, first)
            seed = derived_seed(config.seed, "view", view)
            image = scene.render(cameras, view, light, config.samples_per_pixel, seed)
            channels = {name: image[..., index] for index, name in enumerate("RGBA")}
            write_exr(reference_path(out, view), channels, half=False)
        write_json(out / "cameras.json", cameras.to_dict())
        artefact.finish({"num_views": len(cameras)})
    return out


def reference_path(folder: Path, view: int) -> Path:
    """linear/<000>.exr of the references in `folder`."""
    return folder / "linear" / f"{view:03d}.exr"


def object_file(folder: Path) -> Path:
    """The one object file in `folder`; UserError where there is none or several."""
    found = sorted(path for path in folder.glob("*") if path.suffix.lower() in OBJECT_SUFFIXES)
    if len(found) != 1:
        raise UserError(
            "the true mesh is not where it should be",
            got=f"{', '.join(path.name for path in found) or 'no object file'} in {folder}",
            wanted=f"one file of {', '.join(OBJECT_SUFFIXES)}",
        )
    return found[0]


def _light(path: Path, config: Config, like: EnvironmentMap | None) -> EnvironmentMap:
    """A map of at most so many rows; all of one scene have the first one's."""
    light = EnvironmentMap.load(path)
    rows = min(light.linear_rgb.shape[0], config.max_light_height) if like is None else like.linear_rgb.shape[0]
    return light.resized(rows)
