"""Radiance cues: what four simple materials on the object's geometry look like under a light.

Paper, section 3.2 and supplement: one white diffuse material and three white GGX lobes of roughness 0.05, 0.13 and
0.34, path traced. The same function serves training pairs and inference, so the relighting model sees one kind of cue.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from illuminerf.cues.mitsuba_scene import MitsubaScene, mitsuba_mesh
from illuminerf.cues.mitsuba_variant import load_mitsuba
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.device import derived_seed
from illuminerf.workflow.errors import UserError

CUE_ROUGHNESS = (0.05, 0.13, 0.34)
CUE_NAMES = ("diffuse", "ggx_005", "ggx_013", "ggx_034")
CUE_CHANNELS = tuple(f"{name}.{channel}" for name in CUE_NAMES for channel in "RGB")


@dataclass(frozen=True)
class CueSampling:
    """How cues are path traced; training and inference must use the same bounces."""

    samples_per_pixel: int = 64
    """Paths per pixel and material."""
    diffuse_depth: int = 6
    """Longest path, in edges, of the diffuse cue: all visible interreflections."""
    specular_depth: int = 2
    """Longest path of the specular cues; 2 is direct light with shadowing.
    Deviation: the paper does not say. White GGX lobes that see each other under small lamps are mostly noise at any
    affordable number of samples (13 to 18 dB at 64), direct light alone reaches 30 dB; the diffuse cue carries the
    interreflections."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if self.samples_per_pixel < 1:
            raise UserError("samples_per_pixel is too small", got=str(self.samples_per_pixel), wanted="1 or more")
        if min(self.diffuse_depth, self.specular_depth) < 2:
            raise UserError("paths are too short to carry light", wanted="a depth of 2 or more")


class CueRenderer(Protocol):
    """A path tracer that holds one mesh."""

    def render(self, cameras: Cameras, view: int, light: EnvironmentMap, seed: int) -> np.ndarray:
        """Cues of one view: float32 [13, height, width], `CUE_CHANNELS` linear premultiplied, then coverage."""
        ...


class MitsubaCueRenderer:
    """`CueRenderer` on Mitsuba: geometry is built once, then only light, roughness and camera change.

    Args:
        mesh: the object in the world of the cameras.
        light: the first light; its resolution is that of all later ones.
        sampling: paths and bounces.
        only_diffuse: leave the specular materials out.
    """

    def __init__(
        self, mesh: TriangleMesh, light: EnvironmentMap, sampling: CueSampling, only_diffuse: bool = False
    ) -> None:
        mi = load_mitsuba(sampling.device)
        self.sampling = sampling
        white: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
        conductor = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.1}
        # Hybrid shading normals (paper, supplement "Shading Normals"): faces for diffuse, smooth for specular.
        flat = mitsuba_mesh(mi, "flat", mesh.vertices, mesh.faces, _two_sided(white))
        self._diffuse = MitsubaScene({"mesh": flat}, light, sampling.device)
        self._specular: MitsubaScene | None = None
        if not only_diffuse:
            smooth = mitsuba_mesh(
                mi, "smooth", mesh.vertices, mesh.faces, _two_sided(conductor), vertex_normals=mesh.vertex_normals
            )
            self._specular = MitsubaScene({"mesh": smooth}, light, sampling.device)
            names = self._specular.parameters.keys()
            self._alpha_name = next(name for name in names if name.endswith("alpha.value"))
        self._light: EnvironmentMap | None = None

    def render(self, cameras: Cameras, view: int, light: EnvironmentMap, seed: int) -> np.ndarray:
        """Cues of one view: float32 [13, height, width], `CUE_CHANNELS` linear premultiplied, then coverage; or
        [4, height, width], those of the diffuse material alone."""
        if light is not self._light:
            for scene in (self._diffuse, self._specular):
                if scene is not None:
                    scene.set_light(light)
            self._light = light
        spp, settings = self.sampling.samples_per_pixel, self.sampling
        diffuse = self._diffuse.render(cameras, view, settings.diffuse_depth, spp, derived_seed(seed, "diffuse"))
        layers = [diffuse[..., :3]]
        if self._specular is not None:
            for roughness in CUE_ROUGHNESS:
                self._specular.set_values(**{self._alpha_name.replace(".", "__"): roughness**2})
                image = self._specular.render(
                    cameras, view, settings.specular_depth, spp, derived_seed(seed, "specular", roughness)
                )
                layers.append(image[..., :3])
        layers.append(np.clip(diffuse[..., 3:4], 0, 1))
        return np.ascontiguousarray(np.concatenate(layers, -1).transpose(2, 0, 1))


def _two_sided(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "front": bsdf}


def render_cues(
    mesh: TriangleMesh,
    cameras: Cameras,
    light: EnvironmentMap,
    sampling: CueSampling,
    seed: int,
    views: list[int] | None = None,
    only_diffuse: bool = False,
) -> Iterator[np.ndarray]:
    """Radiance cues of a mesh, view by view.

    Args:
        mesh: the object in the world of the cameras.
        cameras: the views; the principal point may be anywhere.
        light: linear radiance in the world's axes.
        sampling: paths and bounces.
        seed: each view's own seed is derived from it and the view's index, so views do not depend on each other.
        views: which views, default all.
        only_diffuse: leave the specular materials out.

    Yields:
        float32 [13, height, width] per view: `CUE_CHANNELS`, linear and premultiplied, then coverage; with
        `only_diffuse` [4, height, width], the same values of the diffuse material.
    """
    renderer = MitsubaCueRenderer(mesh, light, sampling, only_diffuse)
    for view in range(len(cameras)) if views is None else views:
        yield renderer.render(cameras, view, light, derived_seed(seed, "view", view))
