"""Geometry + capture + light -> radiance cues of every captured view (paper, section 3.2).

cues/<000>.exr        12 half channels `CUE_CHANNELS`, linear and premultiplied, and `A`, the mesh's coverage
light.exr, light.json the light as it was used, and how it was turned and exposed

Several processes or machines can share the views on one folder: `--shard 0/4`, `--shard 1/4`, ..., or one torchrun.
Whoever finds every view in place seals the artefact.
"""

from dataclasses import dataclass, replace
from pathlib import Path

from illuminerf.cues.renderer import CUE_CHANNELS, CueSampling, render_cues
from illuminerf.data.capture import load_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_exr, write_exr
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.processes import shard_of
from illuminerf.workflow.progress import say, step_progress

STAGE = "render_radiance_cues"
_MAX_STOPS = 30.0


@dataclass(frozen=True)
class Config:
    """How the light is placed and the cues are path traced."""

    sampling: CueSampling = CueSampling()
    """Paths and bounces; bounces as the relighting model was trained with."""
    light_rotation_radians: float = 0.0
    """Turn of the light about the world's +z, counter-clockwise seen from above."""
    exposure_stops: float = 0.0
    """The light's radiance times 2^stops."""
    max_light_height: int = 512
    """Rows; larger lights are averaged down, so that small lamps keep their energy."""
    shard: str = ""
    """Share of the views that this process renders, i/n from 0/n; "": all, or what torchrun says. Changes no result."""
    seed: int = 0
    """Each view's seed is derived from it."""

    def __post_init__(self) -> None:
        shard_of(self.shard)
        if not abs(self.exposure_stops) <= _MAX_STOPS:
            raise UserError("exposure_stops is out of range", got=str(self.exposure_stops), wanted="-30 to 30")
        if not abs(self.light_rotation_radians) < float("inf"):
            raise UserError("light_rotation_radians must be finite", got=str(self.light_rotation_radians))
        if self.max_light_height < 1:
            raise UserError("max_light_height must be positive", got=str(self.max_light_height))


def run(geometry: Path, capture: Path, light: Path, config: Config, out: Path) -> Path:
    """Render the cues of all views of `capture` under `light` into `out`; views that exist are kept.

    Args:
        geometry: a Geometry artefact; its `mesh.glb` lies in the capture's unit ball.
        capture: a Capture artefact.
        light: an environment map file, z-up (docs/conventions.md).
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: an input is missing or unusable, or `out` was made with other settings.
    """
    shard, num_shards = shard_of(config.shard)
    inputs: dict[str, Path | str] = {"geometry": geometry, "capture": capture, "light": light}
    with open_artefact(out, STAGE, replace(config, shard=""), inputs, is_shared=num_shards > 1) as artefact:
        if artefact.is_done:
            return out
        placed = placed_light(light, config)
        cameras = load_cameras(capture)
        mesh = TriangleMesh.load_glb(geometry / "mesh.glb")
        placed.save(out / "light.exr")
        write_json(
            out / "light.json",
            {
                "name": placed.name,
                "rotation_radians": config.light_rotation_radians,
                "exposure_stops": config.exposure_stops,
            },
        )
        views = range(len(cameras))
        ours = views[shard::num_shards]
        missing = [view for view in ours if not cue_path(out, view).exists()]
        with step_progress("radiance cues", len(ours), len(ours) - len(missing)) as progress:
            rendered = render_cues(mesh, cameras, placed, config.sampling, config.seed, missing) if missing else ()
            for view, image in zip(missing, rendered, strict=True):
                write_exr(cue_path(out, view), dict(zip((*CUE_CHANNELS, "A"), image, strict=True)))
                progress.advance()
        if not all(cue_path(out, view).exists() for view in views):
            say(f"share {shard}/{num_shards} is done; others are not yet")
            return out
        if not any(read_exr(cue_path(out, view))["A"].any() for view in views):
            raise UserError(
                "no view sees the mesh", fix="check that geometry and capture belong together, and delete the folder"
            )
        artefact.finish({"num_views": len(cameras)})
    return out


def cue_path(cues: Path, view: int) -> Path:
    """cues/<000>.exr of the artefact in `cues`."""
    return cues / "cues" / f"{view:03d}.exr"


def placed_light(light: Path, config: Config) -> EnvironmentMap:
    """The light of a file, averaged down if large, turned and exposed."""
    loaded = EnvironmentMap.load(light)
    loaded = loaded.resized(min(loaded.linear_rgb.shape[0], config.max_light_height))
    return loaded.rotated(config.light_rotation_radians).exposed(config.exposure_stops)
