"""One training item: an object from one camera under several lights, with its radiance cues and its G-buffer.

`ItemRenderer` is what a path tracer has to do for the training data; `MitsubaItemRenderer` is the default one,
`BlenderItemRenderer` (blender_renderer.py) the paper's.
"""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from illuminerf.cues.materials import Parts
from illuminerf.cues.renderer import CueSampling, MitsubaCueRenderer
from illuminerf.cues.shading import ShadedScene, concatenated
from illuminerf.cues.texture_baking import baked
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.device import derived_seed


@dataclass(frozen=True)
class RenderedItem:
    """What one camera sees; radiance is linear rec.709, unclipped and premultiplied by coverage.

    Attributes:
        targets: float32 [lights, 3, height, width], the object with its own materials.
        cues: float32 [lights, 12, height, width], channels as `CUE_CHANNELS`.
        alpha: float32 [height, width], coverage in [0, 1].
        base_color: float32 [3, height, width], linear, straight, in [0, 1].
        roughness, metallic: float32 [height, width], straight, in [0, 1].
        normal: float32 [3, height, width], unit shading normal in the world, towards the camera; 0 off the object.
    """

    targets: np.ndarray
    cues: np.ndarray
    alpha: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal: np.ndarray


@runtime_checkable
class ItemRenderer(Protocol):
    """A path tracer for training items. The same arguments give the same arrays."""

    def render(
        self,
        parts: Parts,
        camera: Cameras,
        lights: list[EnvironmentMap],
        seed: int,
        cue_mesh: TriangleMesh | None = None,
    ) -> RenderedItem:
        """Render what the first view of `camera` sees of `parts`, once per light.

        Args:
            parts: meshes with materials, in the world of the camera, within the unit sphere.
            camera: one view.
            lights: equirectangular maps of one resolution, in our axes.
            seed: every random stream is derived from it.
            cue_mesh: what the cues are rendered from; None: the meshes of `parts`.
        """
        ...


@dataclass(frozen=True)
class MitsubaItemRenderer:
    """`ItemRenderer` on Mitsuba."""

    samples_per_pixel: int = 16
    """Paths per pixel of the targets."""
    cue_sampling: CueSampling = field(default_factory=lambda: CueSampling(samples_per_pixel=16))
    """Paths and bounces of the cues."""
    bakes_textures: bool = True
    """Move textures onto vertices first."""

    def render(
        self,
        parts: Parts,
        camera: Cameras,
        lights: list[EnvironmentMap],
        seed: int,
        cue_mesh: TriangleMesh | None = None,
    ) -> RenderedItem:
        """Render what the first view of `camera` sees of `parts`, once per light."""
        scene = ShadedScene(baked(parts) if self.bakes_textures else parts, lights[0], self.cue_sampling.device)
        cue_mesh = concatenated([mesh for mesh, _ in parts]) if cue_mesh is None else cue_mesh
        tracer = MitsubaCueRenderer(cue_mesh, lights[0], self.cue_sampling)
        targets, cues = [], []
        alpha = np.zeros(0, np.float32)
        for index, light in enumerate(lights):
            image = scene.render(camera, 0, light, self.samples_per_pixel, derived_seed(seed, "target", index))
            targets.append(image[..., :3].transpose(2, 0, 1))
            cues.append(tracer.render(camera, 0, light, derived_seed(seed, "cues", index))[:12])
            alpha = np.clip(image[..., 3], 0, 1) if index == 0 else alpha
        return RenderedItem(np.stack(targets), np.stack(cues), alpha, *surface_of(scene, camera))


def surface_of(scene: ShadedScene, camera: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Base colour, roughness, metallic and normal of what the first view sees, as `RenderedItem` holds them."""
    surface = scene.properties(camera, 0)
    coverage = np.maximum(surface["coverage"], 1e-3)
    return (
        np.clip(surface["base_color"] / coverage[..., None], 0, 1).transpose(2, 0, 1),
        np.clip(surface["roughness"] / coverage, 0, 1),
        np.clip(surface["metallic"] / coverage, 0, 1),
        surface["normal"].transpose(2, 0, 1),
    )
