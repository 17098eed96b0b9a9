"""Model file + light -> a capture of it with the truth: what geometry estimation is measured on.

images/<000>.png, cameras.json    the photographs, in the plain layout of docs/captures.md
test/images/<000>.png             views that were not photographed, under the same light; with test/cameras.json and
                                  test/capture.json, so that it is a capture too
test/normals/<000>.exr            their true shading normals X, Y, Z in the world, and coverage A
truth/mesh.glb                    the model in the world of all these cameras
light.exr                         the light as it was used

Cameras are those of NeRF-synthetic: they look at the model, which lies in the unit sphere, from 4.03 away with a field
of view of 39.6 degrees. Photographs are taken from random places on the upper half of the sphere (or all of it), unseen
views from places that are spread over the same part evenly.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from illuminerf.cues.materials import Parts
from illuminerf.cues.object_files import ObjectReading, load_object
from illuminerf.cues.shading import ShadedScene, concatenated, developed
from illuminerf.scene.cameras import Cameras, sphere_cameras, spiral_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import write_exr, write_png
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.device import derived_seed, numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

DISTANCE, FOV_RADIANS = 4.031, 0.6911
"""Of the cameras of NeRF-synthetic."""


@dataclass(frozen=True)
class Config:
    """Size and quality of the capture."""

    num_views: int = 100
    """Photographs."""
    num_test_views: int = 20
    """Unseen views."""
    size: int = 400
    """Pixels along each side."""
    samples_per_pixel: int = 64
    """Paths per pixel."""
    places: Literal["upper", "all"] = "upper"
    """Cameras look from the upper half of the sphere, as in NeRF-synthetic, or from all of it."""
    mean_radiance: float = 0.8
    """The light is exposed so that this is its mean radiance over the sphere: what a white diffuse point that sees all
    of it looks like. Photographs clip at 1."""
    max_light_height: int = 512
    """Rows; larger lights are averaged down."""
    reading: ObjectReading = field(default_factory=ObjectReading)
    """How model files are read, and what those without materials are made of."""
    seed: int = 0
    """Of cameras, paths and missing materials."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if self.num_views < 3 or self.num_test_views < 1 or self.size < 16:
            raise UserError("the capture is too small", wanted="3 views, 1 unseen view and 16 pixels, or more")
        if min(self.samples_per_pixel, self.max_light_height) < 1 or not 0 < self.mean_radiance < float("inf"):
            raise UserError("samples, rows and radiance of the light must be positive", got=str(self))


def run(model: Path, light: Path, config: Config, out: Path) -> Path:
    """Photograph a model under a light into `out`; views that exist are kept.

    Raises:
        BrokenObject: the model cannot be used; nothing has been written then.
        UserError: the light is unusable, or `out` was made with other settings.
    """
    placed = _exposed(EnvironmentMap.load(light), config)
    parts: Parts = []
    if not (out / "DONE").exists():  # before `out` is touched: a broken model leaves nothing behind
        parts = load_object(model, numpy_generator(config.seed, "object", model.stem), config.reading)
    with open_artefact(out, "render_object_capture", config, {"model": model, "light": light}) as artefact:
        if artefact.is_done:
            return out
        photographed, unseen = _photographed(config), _unseen(config)
        scene = ShadedScene(parts, placed, config.device)
        _shoot(scene, placed, photographed, config, out / "images")
        write_json(out / "cameras.json", photographed.to_dict())
        _shoot(scene, placed, unseen, config, out / "test" / "images")
        _draw_normals(scene, unseen, out)
        write_json(out / "test" / "cameras.json", unseen.to_dict())
        names = [f"{view:03d}" for view in range(len(unseen))]
        world = {"scale": 1.0, "offset": [0.0, 0.0, 0.0], "background": "masked", "names": names}
        write_json(out / "test" / "capture.json", world)
        placed.save(out / "light.exr")
        num_faces = _save_truth(parts, out / "truth" / "mesh.glb")
        artefact.finish({"views": config.num_views, "test_views": config.num_test_views, "num_faces": num_faces})
    return out


def normals_path(capture: Path, view: int) -> Path:
    """test/normals/<000>.exr of the artefact in `capture`."""
    return capture / "test" / "normals" / f"{view:03d}.exr"


def _exposed(light: EnvironmentMap, config: Config) -> EnvironmentMap:
    light = light.resized(min(light.linear_rgb.shape[0], config.max_light_height))
    return light.exposed(float(np.log2(config.mean_radiance / light.mean_radiance().mean())))


def _band(config: Config) -> tuple[float, float]:
    return (0.0 if config.places == "upper" else -np.pi / 2), np.pi / 2


def _photographed(config: Config) -> Cameras:
    generator = numpy_generator(config.seed, "photographs")
    size = (config.size, config.size)
    return sphere_cameras(config.num_views, DISTANCE, FOV_RADIANS, *size, generator, *_band(config))


def _unseen(config: Config) -> Cameras:
    size = (config.size, config.size)
    return spiral_cameras(config.num_test_views, DISTANCE, FOV_RADIANS, *size, *_band(config))


def _shoot(scene: ShadedScene, light: EnvironmentMap, cameras: Cameras, config: Config, folder: Path) -> None:
    what = "photographs" if folder.parent.name != "test" else "unseen views"
    for view in track(range(len(cameras)), f"render {what}"):
        path = folder / f"{view:03d}.png"
        if not path.exists():
            seed = derived_seed(config.seed, what, view)
            write_png(path, developed(scene.render(cameras, view, light, config.samples_per_pixel, seed)))


def _draw_normals(scene: ShadedScene, cameras: Cameras, out: Path) -> None:
    for view in track(range(len(cameras)), "render true normals"):
        path = normals_path(out, view)
        if not path.exists():
            found = scene.properties(cameras, view)
            channels = {name: found["normal"][..., i] for i, name in enumerate("XYZ")}
            write_exr(path, channels | {"A": found["coverage"]})


def _save_truth(parts: Parts, path: Path) -> int:
    mesh = concatenated([mesh for mesh, _ in parts])
    mesh.save_glb(path)
    return len(mesh.faces)
