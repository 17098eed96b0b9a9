"""Formulas -> the capture that ships with the package: photographs under one light, truth under another.

images/<000>.png, cameras.json        the photographs, in the plain layout of docs/captures.md
test/cameras.json                     views that were not photographed
test/<light>/<000>.png                their truth under the input and the target light, straight RGBA
lights/<light>.exr                    both lights; a relighting is told the target's only
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from illuminerf.cues.materials import Material
from illuminerf.cues.shading import render_shaded
from illuminerf.scene.cameras import Cameras, sphere_cameras, spiral_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import linear_from_srgb, write_png
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.procedural import duck_still_life, evening_light, studio_light
from illuminerf.scene.views import Views
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.device import numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

_RADIUS, _FOV_RADIANS = 3.4, float(np.radians(33))


@dataclass(frozen=True)
class Config:
    """Size and quality of the demo capture."""

    num_views: int = 30
    """Photographs."""
    num_test_views: int = 8
    """Views with truth under both lights."""
    size: int = 128
    """Pixels along each side."""
    samples_per_pixel: int = 256
    """Paths per pixel."""
    mesh_resolution: int = 160
    """Grid points per axis for the marching cubes of each object."""
    seed: int = 0
    """Of the cameras and the paths."""

    def __post_init__(self) -> None:
        if min(self.num_views, self.num_test_views) < 3 or self.size < 16:
            raise UserError("the demo capture is too small", wanted="at least 3 views of each kind, 16 pixels")


def run(config: Config, out: Path) -> Path:
    """Render the capture into `out`."""
    with open_artefact(out, "render_demo_capture", config, {}) as artefact:
        if artefact.is_done:
            return out
        parts = [
            (o.mesh, Material(linear_from_srgb(_vertex_colors(o.mesh.vertex_colors)), o.roughness, o.metallic))
            for o in duck_still_life(config.mesh_resolution)
        ]
        studio, evening = studio_light(), evening_light()
        photographed = _photographed(config)
        _write(out, "images", photographed, parts, studio, config)
        write_json(out / "cameras.json", photographed.to_dict())
        unseen = _unseen(config)
        for light in (studio, evening):
            folder = f"test/{light.name}"
            _write(out, f"{folder}/images", unseen, parts, light, config)
            write_json(out / folder / "cameras.json", unseen.to_dict())
            names = [f"{view:03d}" for view in range(len(unseen))]
            world = {"scale": 1.0, "offset": [0.0, 0.0, 0.0], "background": "masked", "names": names}
            write_json(out / folder / "capture.json", world)
            light.save(out / "lights" / f"{light.name}.exr")
        artefact.finish({"views": config.num_views, "test_views": config.num_test_views})
    return out


def _vertex_colors(srgb: np.ndarray | None) -> np.ndarray:
    if srgb is None:
        raise UserError("a procedural object has no vertex colours")
    return srgb


def _photographed(config: Config) -> Cameras:
    band = (np.radians(8), np.radians(72))
    return spiral_cameras(config.num_views, _RADIUS, _FOV_RADIANS, config.size, config.size, *band)


def _unseen(config: Config) -> Cameras:
    generator = numpy_generator(config.seed, "unseen views")
    band = (np.radians(12), np.radians(60))
    return sphere_cameras(config.num_test_views, _RADIUS, _FOV_RADIANS, config.size, config.size, generator, *band)


def _write(
    out: Path,
    folder: str,
    cameras: Cameras,
    parts: list[tuple[TriangleMesh, Material]],
    light: EnvironmentMap,
    config: Config,
) -> None:
    for view in track(range(len(cameras)), f"render {folder}"):
        path = out / folder / f"{view:03d}.png"
        if path.exists():
            continue
        seed = config.seed + 1000 * view
        views: Views = render_shaded(parts, cameras[view], light, config.samples_per_pixel, seed)
        write_png(path, np.dstack([views.srgb[0], views.alpha[0]]))
