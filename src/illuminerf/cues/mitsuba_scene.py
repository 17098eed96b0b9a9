"""A Mitsuba scene that stays built while light, materials and cameras change."""

from typing import Any

import numpy as np

from illuminerf.cues.mitsuba_variant import load_mitsuba
from illuminerf.cues.mitsuba_wavefront import rendered_pixels
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.workflow.device import derived_seed
from illuminerf.workflow.errors import UserError

# Mitsuba keeps all samples of a pass in memory. 2^20 of them need about 0.5 GB; twice as many take longer per sample
# (docs/log.md).
_SAMPLES_PER_PASS = 2**20
# Pixels of a side of what one thread of scalar_rgb renders. Left to itself Mitsuba makes as many blocks as there are
# threads, and each block has its own random numbers.
_BLOCK_SIDE = 32
WORLD_FROM_ENVMAP = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Our equirectangular axes in Mitsuba's own frame for environment maps (docs/conventions.md)."""
_OPENGL_FROM_MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])


class MitsubaScene:
    """Shapes under one environment light, seen by one camera.

    Args:
        shapes: by name, Mitsuba shape objects (or dictionaries).
        light: the first light; later ones must have its resolution.
        device: "auto", "cpu" or "cuda".
    """

    def __init__(self, shapes: dict[str, Any], light: EnvironmentMap, device: str = "auto") -> None:
        self.mitsuba = load_mitsuba(device)
        mi = self.mitsuba
        film = {
            "type": "hdrfilm",
            "width": 16,
            "height": 16,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        self.light_shape = light.linear_rgb.shape
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "light": {
                    "type": "envmap",
                    "bitmap": mi.Bitmap(rows_from_pole_to_pole(light.linear_rgb)),
                    "to_world": mi.ScalarTransform4f(WORLD_FROM_ENVMAP),
                },
                **shapes,
            }
        )
        self._film = film
        self._sensors: dict[tuple[int, int], tuple[Any, Any]] = {}
        self._integrators: dict[tuple[Any, ...], Any] = {}
        self.parameters = mi.traverse(self.scene)

    def set_light(self, light: EnvironmentMap) -> None:
        """Exchange the light's radiance."""
        if light.linear_rgb.shape != self.light_shape:
            raise UserError(
                "the lights of one scene must have one resolution",
                got=str(light.linear_rgb.shape),
                wanted=str(self.light_shape),
                fix="resize the lights",
            )
        # Mitsuba pads the map by one wrapped column at either side
        rows = rows_from_pole_to_pole(light.linear_rgb)
        padded = np.concatenate([rows[:, -1:], rows, rows[:, :1]], 1)
        self.parameters["light.data"] = self.mitsuba.TensorXf(np.ascontiguousarray(padded, np.float32))
        self.parameters.update()

    def set_values(self, **values: Any) -> None:
        """Exchange material values, by their traversal name with `__` for `.`."""
        for name, value in values.items():
            self.parameters[name.replace("__", ".")] = value
        self.parameters.update()

    def _sensor(self, cameras: Cameras, view: int) -> Any:
        mi = self.mitsuba
        height, width = cameras.height, cameras.width
        if (height, width) not in self._sensors:
            film = {**self._film, "width": width, "height": height}
            sensor = mi.load_dict(
                {
                    "type": "perspective",
                    "fov": 40.0,
                    "fov_axis": "x",
                    "near_clip": 1e-3,
                    "far_clip": 1e4,
                    "film": film,
                    "sampler": {"type": "multijitter"},
                }
            )
            self._sensors[height, width] = (sensor, mi.traverse(sensor))
        sensor, parameters = self._sensors[height, width]
        fx, _, cx, cy = cameras.intrinsics[view]
        parameters["x_fov"] = float(np.degrees(2 * np.arctan(0.5 * width / fx)))
        parameters["principal_point_offset_x"] = float(0.5 - cx / width)
        parameters["principal_point_offset_y"] = float(0.5 - cy / height)
        parameters["to_world"] = mi.ScalarTransform4f(cameras.world_from_camera[view] @ _OPENGL_FROM_MITSUBA)
        parameters.update()
        return sensor

    def _integrator(self, kind: str, options: dict[str, Any]) -> Any:
        key = (kind, *sorted(options.items()))
        if key not in self._integrators:
            self._integrators[key] = self.mitsuba.load_dict({"type": kind, "block_size": _BLOCK_SIDE, **options})
        return self._integrators[key]

    def render(self, cameras: Cameras, view: int, max_depth: int, samples_per_pixel: int, seed: int) -> np.ndarray:
        """Path trace one view: float32 [height, width, 4], linear premultiplied radiance and coverage."""
        options = {"max_depth": max_depth, "hide_emitters": True}
        return self._rendered("path", options, cameras, view, samples_per_pixel, seed)

    def render_aovs(self, aovs: str, cameras: Cameras, view: int, samples_per_pixel: int, seed: int) -> np.ndarray:
        """Mitsuba's `aov` integrator, channels in the order named, averaged over the pixel (0 off the shapes)."""
        return self._rendered("aov", {"aovs": aovs}, cameras, view, samples_per_pixel, seed)

    def _rendered(
        self, kind: str, options: dict[str, Any], cameras: Cameras, view: int, samples_per_pixel: int, seed: int
    ) -> np.ndarray:
        square = _with_square_pixels(cameras, view)
        sensor, integrator = self._sensor(square, 0), self._integrator(kind, options)
        per_pass = max(1, _SAMPLES_PER_PASS // (square.height * square.width))
        num_passes = -(-samples_per_pixel // per_pass)
        total, counted = np.zeros(0, np.float32), 0
        for index in range(num_passes):
            spp = samples_per_pixel // num_passes + (index < samples_per_pixel % num_passes)
            values, drawn = self._one_pass(sensor, integrator, derived_seed(seed, index) % 2**32, spp)
            total, counted = (drawn * values if index == 0 else total + drawn * values), counted + drawn
        image = total / np.float32(counted)
        return image if square.height == cameras.height else _rows_resampled(image, cameras, view)

    def _one_pass(self, sensor: Any, integrator: Any, seed: int, spp: int) -> tuple[np.ndarray, int]:
        """The same bytes with any number of threads, and the samples per pixel, which the sampler may round up."""
        if not self.mitsuba.variant().startswith("scalar"):
            return rendered_pixels(self.mitsuba, self.scene, sensor, integrator, seed, spp)
        image = self.mitsuba.render(self.scene, sensor=sensor, integrator=integrator, seed=seed, spp=spp)
        # a path of zero probability can give a NaN in single precision; it carries no light
        values = np.nan_to_num(np.array(image, np.float32), nan=0.0, posinf=0.0, neginf=0.0)
        return values, int(sensor.sampler().sample_count())


def rows_from_pole_to_pole(linear_rgb: np.ndarray) -> np.ndarray:
    """Our maps have their samples in the middle of each row; Mitsuba's first and last row lie on the poles."""
    height = len(linear_rgb)
    at = np.clip(np.arange(height) * (height / max(height - 1, 1)) - 0.5, 0, height - 1)
    above = np.minimum(at.astype(int), max(height - 2, 0))
    share = (at - above).astype(np.float32)[:, None, None]
    below = np.minimum(above + 1, height - 1)
    return np.ascontiguousarray((1 - share) * linear_rgb[above] + share * linear_rgb[below], np.float32)


def _with_square_pixels(cameras: Cameras, view: int) -> Cameras:
    """The view with fy = fx, which is all that Mitsuba's camera knows; its rows are then `_rows_resampled`."""
    fx, fy, cx, cy = cameras.intrinsics[view]
    stretch = fx / fy
    if abs(stretch - 1) * cameras.height < 0.02:  # a fiftieth of a pixel over the whole image
        return cameras[view]
    intrinsics = np.array([[fx, fx, cx, cy * stretch]])
    return Cameras(cameras[view].world_from_camera, intrinsics, int(np.ceil(cameras.height * stretch)), cameras.width)


def _rows_resampled(image: np.ndarray, cameras: Cameras, view: int) -> np.ndarray:
    """Average square pixels over the rows of the real ones, by the share of each that they cover."""
    fx, fy, _, _ = cameras.intrinsics[view]
    edges = np.arange(cameras.height + 1) * fx / fy
    source = np.arange(image.shape[0])
    shares = np.minimum(edges[1:, None], source + 1) - np.maximum(edges[:-1, None], source)
    weights = np.clip(shares, 0, None)
    weights /= weights.sum(1, keepdims=True)
    return np.einsum("hs,swc->hwc", weights.astype(np.float32), image)


def mitsuba_mesh(
    mi: Any,
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    bsdf: dict[str, Any],
    vertex_normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    attributes: dict[str, np.ndarray] | None = None,
) -> Any:
    """A Mitsuba mesh from arrays, without files. No vertex normals: flat faces. `uv` has v = 0 at the bottom."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(
        name,
        len(vertices),
        len(faces),
        has_vertex_normals=vertex_normals is not None,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    for attribute, values in (attributes or {}).items():
        mesh.add_attribute(attribute, values.shape[1], np.ascontiguousarray(values, np.float32).ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
    if vertex_normals is not None:
        parameters["vertex_normals"] = np.ascontiguousarray(vertex_normals, np.float32).ravel()
    if uv is not None:
        # Mitsuba's v = 0 is the top row
        flipped = np.stack([uv[:, 0], 1 - uv[:, 1]], -1)
        parameters["vertex_texcoords"] = np.ascontiguousarray(flipped, np.float32).ravel()
    parameters.update()
    return mesh
