"""Camera, light, latent -> picture: everything the viewer shows, without a browser."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from illuminerf.cues.renderer import CUE_NAMES, CueSampling, MitsubaCueRenderer
from illuminerf.fields.image_rendering import RenderedImage, render_image_as_trained
from illuminerf.fields.storage import StoredField, load_field
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear
from illuminerf.scene.light_preview import matte_ball
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.viewer.finished_run import FinishedRun
from illuminerf.workflow.device import resolve_device

AS_PHOTOGRAPHED = "(as photographed)"
"""In place of a light's name: the appearance that was fitted to the photographs."""
RELIT, NORMALS, CUES = "relit", "normals", ("diffuse cue", "GGX 0.05 cue", "GGX 0.13 cue", "GGX 0.34 cue")
MODES = (RELIT, NORMALS, *CUES)
FAR = 100.0
_CUE_SAMPLES = 16
_BRIGHTEST_WHITE = 0.9  # linear, of a white ball in the open
_BACKGROUND = 1.0
_LEAST_ALPHA = 1e-3


@dataclass(frozen=True)
class Look:
    """What is looked at.

    Attributes:
        light: a name of the renderer's `lights`.
        mode: one of MODES.
        latent: 0 is the zero code, n the code of the n-th relit sample; between two whole numbers codes are blended.
    """

    light: str
    mode: str = RELIT
    latent: float = 0.0


@dataclass(frozen=True)
class Picture:
    """One view over white.

    Attributes:
        srgb: float32 [height, width, 3] in [0, 1].
        depth: float32 [height, width] along the camera's axis, FAR where nothing is.
    """

    srgb: np.ndarray
    depth: np.ndarray


class ViewRenderer:
    """Renders views of a finished run. Fields, meshes and path tracers are loaded when they are first asked for."""

    def __init__(self, run: FinishedRun, device: str = "auto") -> None:
        self.run = run
        self.lights = (*run.lights, AS_PHOTOGRAPHED)
        self._device_name, self._device = device, resolve_device(device)
        self._fields: dict[str, StoredField] = {}
        self._tracers: dict[str, tuple[MitsubaCueRenderer, EnvironmentMap, float]] = {}
        self._mesh: TriangleMesh | None = None

    def num_latents(self, light: str) -> int:
        """How many codes the latent NeRF of a light has."""
        latents = self._field(light).latents
        return 0 if latents is None else len(latents)

    def modes(self, light: str) -> tuple[str, ...]:
        """Modes that this light has; the photographs' own is no map that cues could be traced under."""
        return MODES if light in self.run.lights else (RELIT, NORMALS)

    def mesh(self) -> TriangleMesh:
        """The estimated geometry."""
        if self._mesh is None:
            self._mesh = TriangleMesh.load_glb(self.run.geometry / "mesh.glb")
        return self._mesh

    def render(self, camera: Cameras, look: Look) -> Picture:
        """The one view of `camera`."""
        if look.mode in CUES:
            return self._cue(camera, look)
        stored = self._field(look.light)
        image = self._image(stored, camera, code_at(stored.latents, look.latent))
        srgb = image.srgb
        if look.mode == NORMALS:
            length = np.maximum(np.linalg.norm(image.normals, axis=-1, keepdims=True), 1e-6)
            srgb = (0.5 + 0.5 * image.normals / length) * image.alpha[..., None]
        return Picture(_over_white(srgb, image.alpha), _axial_depth(camera, image))

    def bands(self, camera: Cameras, look: Look, rows: int) -> Iterator[Picture]:
        """`render` in bands of so many rows, from the top, so that it can be given up in between."""
        for top in range(0, camera.height, rows):
            yield self.render(band_of(camera, top, min(rows, camera.height - top)), look)

    def _image(self, stored: StoredField, camera: Cameras, latent: torch.Tensor | None) -> RenderedImage:
        return render_image_as_trained(stored.field, stored.cells, camera, 0, latent)

    def _field(self, light: str) -> StoredField:
        if light not in self._fields:
            folder = self.run.lights[light] / "latent_nerf" if light in self.run.lights else self.run.geometry
            self._fields[light] = load_field(folder, self._device)
        return self._fields[light]

    def _cue(self, camera: Cameras, look: Look) -> Picture:
        if look.light not in self._tracers:
            light = EnvironmentMap.load(self.run.lights[look.light] / "cues" / "light.exr")
            sampling = CueSampling(samples_per_pixel=_CUE_SAMPLES, device=self._device_name)
            # of the light, not of the picture: bands must fit together
            exposure = _BRIGHTEST_WHITE / max(float(matte_ball(light, 32)[0].max()), 1e-6)
            self._tracers[look.light] = MitsubaCueRenderer(self.mesh(), light, sampling), light, exposure
        tracer, light, exposure = self._tracers[look.light]
        layers = tracer.render(camera, 0, light, seed=0)
        first = 3 * CUES.index(look.mode)
        assert len(layers) == 3 * len(CUE_NAMES) + 1
        linear_rgb = layers[first : first + 3].transpose(1, 2, 0) * exposure
        alpha = layers[-1]
        depth = np.where(alpha > 0.5, float(np.linalg.norm(camera.positions[0])), FAR).astype(np.float32)
        return Picture(_over_white(srgb_from_linear(linear_rgb), alpha), depth)


def code_at(latents: torch.Tensor | None, place: float) -> torch.Tensor | None:
    """The code at a place of the slider: None (zero) at 0, codes 0, 1, ... at 1, 2, ..., straight lines in between."""
    if latents is None or place <= 0:
        return None
    stops = torch.cat([torch.zeros_like(latents[:1]), latents])
    low = min(int(place), len(latents) - 1)
    share = min(place - low, 1.0)
    return (1 - share) * stops[low] + share * stops[low + 1]


def band_of(camera: Cameras, top: int, rows: int) -> Cameras:
    """The camera that sees rows [top, top + rows) of `camera`'s image."""
    intrinsics = camera.intrinsics - np.array([0, 0, 0, top])
    return Cameras(camera.world_from_camera, intrinsics, rows, camera.width)


def _over_white(premultiplied: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return np.clip(premultiplied + _BACKGROUND * (1 - alpha[..., None]), 0, 1).astype(np.float32)


def _axial_depth(camera: Cameras, image: RenderedImage) -> np.ndarray:
    """From distances along rays; where less than half is covered the background is seen."""
    fx, fy, cx, cy = camera.intrinsics[0]
    rows, columns = np.indices(image.alpha.shape) + 0.5
    slant = np.sqrt(1 + ((columns - cx) / fx) ** 2 + ((rows - cy) / fy) ** 2)
    axial = image.depth / np.maximum(image.alpha, _LEAST_ALPHA) / slant
    return np.where(image.alpha > 0.5, axial, FAR).astype(np.float32)
