"""Renderings of objects with metallic-roughness materials: training targets and made-up captures."""

from dataclasses import replace
from typing import Any

import numpy as np

from illuminerf.cues.materials import Material, Parts
from illuminerf.cues.mitsuba_scene import MitsubaScene, mitsuba_mesh
from illuminerf.cues.mitsuba_variant import load_mitsuba
from illuminerf.cues.texture_baking import is_uv_mirrored
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.views import Views
from illuminerf.workflow.device import derived_seed

PATH_DEPTH = 6
"""Longest path of shaded pictures, in edges."""
_PROPERTY_SAMPLES = 16


class ShadedScene:
    """Objects with their materials; lights and cameras may change, geometry is built once.

    Args:
        parts: meshes in the world of the cameras, each with its material.
        light: the first light; its resolution is that of all later ones.
        device: "auto", "cpu" or "cuda".
    """

    def __init__(self, parts: Parts, light: EnvironmentMap, device: str = "auto") -> None:
        self._parts, self._first_light, self._device = _merged(parts), light, device
        shapes = {f"part{i}": _shape(mesh, material, device) for i, (mesh, material) in enumerate(self._parts)}
        self._scene = MitsubaScene(shapes, light, device)
        self._light: EnvironmentMap | None = None

    def render(
        self, cameras: Cameras, view: int, light: EnvironmentMap, samples_per_pixel: int, seed: int
    ) -> np.ndarray:
        """One view: float32 [height, width, 4], linear premultiplied radiance and coverage."""
        if light is not self._light:
            self._scene.set_light(light)
            self._light = light
        return self._scene.render(cameras, view, PATH_DEPTH, samples_per_pixel, seed)

    def properties(self, cameras: Cameras, view: int) -> dict[str, np.ndarray]:
        """What the surface is, without light.

        Returns:
            base_color [h, w, 3] linear, roughness and metallic [h, w], premultiplied by coverage [h, w], and normal
            [h, w, 3], the unit shading normal in the world, normal maps included, turned towards the camera. 0 where
            nothing is seen.
        """
        shapes = {
            f"part{i}": _shape(mesh, material, self._device, unlit=True)
            for i, (mesh, material) in enumerate(self._parts)
        }
        scene = MitsubaScene(shapes, EnvironmentMap(np.ones((4, 8, 3), np.float32)), self._device)
        first = scene.render_aovs(
            "color:albedo,normal:sh_normal,depth:depth,tangent:dp_du,flat:geo_normal",
            cameras,
            view,
            _PROPERTY_SAMPLES,
            0,
        )
        for index, (mesh, material) in enumerate(self._parts):
            _, roughness, metallic = _arrays(mesh, material)
            packed = np.concatenate([roughness, metallic, np.ones_like(roughness)], -1)
            _show(scene, f"part{index}", material.is_textured, packed)
        second = scene.render_aovs("other:albedo", cameras, view, _PROPERTY_SAMPLES, 0)
        found = _unpacked(first, second)
        if any(material.normal_map is not None for _, material in self._parts):
            for index, (mesh, material) in enumerate(self._parts):
                mapped = material.normal_map
                if mapped is None:
                    mapped = np.broadcast_to(np.array([0, 0, 1], np.float32), _arrays(mesh, material)[0].shape)
                _show(scene, f"part{index}", material.is_textured, mapped / 2 + 0.5)
            third = scene.render_aovs("mapped:albedo", cameras, view, _PROPERTY_SAMPLES, 0)
            found["normal"] = _bent(found["normal"], first[..., 7:10], third[..., :3], found["coverage"])
        _, directions = cameras.image_rays(view)
        found["normal"] = toward_camera(found["normal"], first[..., 10:13], directions.numpy())
        return found


def render_shaded(
    parts: Parts,
    cameras: Cameras,
    light: EnvironmentMap,
    samples_per_pixel: int = 64,
    seed: int = 0,
    device: str = "auto",
) -> Views:
    """Path trace a capture of objects under one light, as a camera would store it.

    Args:
        parts: meshes in the world of the cameras, each with its material.
        cameras: the views.
        light: linear radiance; values above 1 in the picture are clipped as in an 8-bit photograph.
        samples_per_pixel: paths per pixel.
        seed: each view's own seed is derived from it.
        device: "auto", "cpu" or "cuda".

    Returns:
        Views with straight sRGB and the coverage as alpha.
    """
    scene = ShadedScene(parts, light, device)
    srgb, alphas = [], []
    for view in range(len(cameras)):
        image = scene.render(cameras, view, light, samples_per_pixel, derived_seed(seed, "view", view))
        photograph = developed(image)
        srgb.append(photograph[..., :3])
        alphas.append(photograph[..., 3])
    return Views(cameras, np.stack(srgb).astype(np.float32), np.stack(alphas).astype(np.float32))


def developed(image: np.ndarray) -> np.ndarray:
    """Straight sRGB and coverage [h, w, 4], clipped like a photograph, of what `ShadedScene.render` returns."""
    alpha = np.clip(image[..., 3:], 0, 1)
    straight = np.clip(image[..., :3] / np.maximum(alpha, 1e-6), 0, 1)
    return np.concatenate([np.where(alpha > 0, srgb_from_linear(straight), 0), alpha], -1)


def concatenated(meshes: list[TriangleMesh]) -> TriangleMesh:
    """Several meshes as one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    return TriangleMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([mesh.vertex_normals for mesh in meshes]),
    )


def _merged(parts: Parts) -> Parts:
    """Untextured parts become one mesh with per-vertex values: fewer shapes, so fewer kernels to compile."""
    plain = [(mesh, material) for mesh, material in parts if not material.is_textured]
    textured = [piece for part in parts if part[1].is_textured for piece in _unmirrored(*part)]
    if not plain:
        return textured
    values = [material.per_vertex(len(mesh.vertices)) for mesh, material in plain]
    color, roughness, metallic = (np.concatenate(arrays) for arrays in zip(*values, strict=True))
    merged = Material(color, roughness[:, 0], metallic[:, 0])
    return [(concatenated([mesh for mesh, _ in plain]), merged), *textured]


def _unmirrored(mesh: TriangleMesh, material: Material) -> Parts:
    """Mitsuba takes +v along normal x tangent: faces that show the picture mirrored need a normal map of their own."""
    if material.normal_map is None:
        return [(mesh, material)]
    assert material.uv is not None
    is_mirrored = is_uv_mirrored(mesh, material.uv)
    flipped = replace(material, normal_map=material.normal_map * np.array([1, -1, 1], np.float32))
    return [
        (TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[chosen]), mesh.vertex_normals), of_side)
        for chosen, of_side in ((~is_mirrored, material), (is_mirrored, flipped))
        if chosen.any()
    ]


def _shape(mesh: TriangleMesh, material: Material, device: str, unlit: bool = False) -> Any:
    """A Mitsuba shape of its material, or with `unlit` one whose albedo is its base colour, for `render_aovs`."""
    mi = load_mitsuba(device)
    attributes = None
    if material.is_textured:
        sources: list[dict[str, Any]] = [
            {"type": "bitmap", "bitmap": mi.Bitmap(np.array(array, np.float32, order="C")), "raw": True}
            for array in material.images()
        ]
    else:
        names = ("vertex_color", "vertex_roughness", "vertex_metallic")
        attributes = dict(zip(names, material.per_vertex(len(mesh.vertices)), strict=True))
        sources = [{"type": "mesh_attribute", "name": name} for name in names]
    bsdf: dict[str, Any] = {
        "type": "principled",
        "base_color": sources[0],
        "roughness": sources[1],
        "metallic": sources[2],
    }
    if unlit:
        bsdf = {"type": "diffuse", "reflectance": sources[0]}
    elif material.normal_map is not None:
        coded = mi.Bitmap(np.array(material.normal_map / 2 + 0.5, np.float32, order="C"))
        bsdf = {
            "type": "normalmap",
            "normalmap": {"type": "bitmap", "bitmap": coded, "raw": True},
            # darkens what tilts away from the face; smooth vertex normals, ours and Blender's, have no such term
            "use_shadowing_function": False,
            "bsdf": bsdf,
        }
    two_sided = {"type": "twosided", "front": bsdf}
    return mitsuba_mesh(mi, "part", mesh.vertices, mesh.faces, two_sided, mesh.vertex_normals, material.uv, attributes)


def _arrays(mesh: TriangleMesh, material: Material) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base colour, roughness and metallic as images or per vertex, the last two with one channel."""
    return material.images() if material.is_textured else material.per_vertex(len(mesh.vertices))


def _show(scene: MitsubaScene, shape: str, is_textured: bool, values: np.ndarray) -> None:
    """Exchange the albedo of an unlit shape for other values, an image [h, w, 3] or per vertex [V, 3]."""
    ending = "reflectance.data" if is_textured else "vertex_color"
    name = next(n for n in scene.parameters.keys() if n.startswith(f"{shape}.") and n.endswith(ending))  # noqa: SIM118
    values = np.ascontiguousarray(values, np.float32)
    scene.set_values(**{name.replace(".", "__"): scene.mitsuba.TensorXf(values) if is_textured else values.ravel()})


def _unpacked(first: np.ndarray, second: np.ndarray) -> dict[str, np.ndarray]:
    normal = first[..., 3:6]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return {
        "base_color": first[..., :3],
        "roughness": second[..., 0],
        "metallic": second[..., 1],
        "coverage": second[..., 2],
        "normal": np.where(first[..., 6:7] > 0, normal / np.maximum(length, 1e-6), 0),
    }


def _bent(normal: np.ndarray, tangent: np.ndarray, coded: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Interpolated normals [h, w, 3] bent by tangent-space ones, coded as (n + 1) / 2 times coverage [h, w]."""
    mapped = 2 * coded / np.maximum(coverage, 1e-3)[..., None] - 1
    tangent = tangent - normal * (normal * tangent).sum(-1, keepdims=True)
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-12)
    bent = tangent * mapped[..., :1] + np.cross(normal, tangent) * mapped[..., 1:2] + normal * mapped[..., 2:]
    return np.where(coverage[..., None] > 0, bent / np.maximum(np.linalg.norm(bent, axis=-1, keepdims=True), 1e-6), 0)


def toward_camera(normal: np.ndarray, flat: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Unit normals [h, w, 3] on the side of the face that is seen; where a smooth or mapped one leans over the horizon
    all the same, it is laid onto it, for turning it round would point it into the surface."""
    flat = np.where((flat * directions).sum(-1, keepdims=True) > 0, -flat, flat)
    normal = np.where((normal * flat).sum(-1, keepdims=True) < 0, -normal, normal)
    normal = normal - directions * np.maximum((normal * directions).sum(-1, keepdims=True), 0)
    return (normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)).astype(np.float32)
