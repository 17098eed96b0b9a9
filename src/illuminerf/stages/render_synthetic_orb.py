"""Formulas -> a small data set in Stanford-ORB's layout (docs/benchmarks.md), to try the benchmark without a download.

By default two objects under two lights make four captures. As in the real one, every capture has a world of its own,
its photographs show what is behind the object, and every test view has a light map in the axes of its camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.cues.materials import Material
from illuminerf.cues.shading import ShadedScene
from illuminerf.data.orb_lights import camera_light
from illuminerf.scene.cameras import Cameras, sphere_cameras, spiral_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear, write_png, write_rgb_exr
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.procedural import ProceduralObject, duck_still_life, evening_light, studio_light
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import write_bytes, write_json
from illuminerf.workflow.device import derived_seed, numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import step_progress

OBJECTS = ("duck", "board", "ball", "cup")
"""As they come in the still life."""
LIGHTS = {"scene001": studio_light, "scene002": evening_light}
_OBJECT_RADIUS, _CAMERA_RADIUS, _FOV_RADIANS = 0.8, 3.0, 0.65


@dataclass(frozen=True)
class Config:
    """Size and quality of the data set."""

    objects: tuple[str, ...] = ("duck", "cup")
    """Of duck, board, ball and cup."""
    size: int = 128
    """Pixels of a side (the benchmark: 2048)."""
    num_views: int = 30
    """Photographs to learn from, per capture."""
    num_test_views: int = 5
    """Per capture."""
    samples_per_pixel: int = 64
    """Paths per pixel."""
    mesh_resolution: int = 96
    """Grid points per axis for the marching cubes of each object."""
    light_height: int = 64
    """Rows of the light maps."""
    probe_error_degrees: float = 0.0
    """Each test view's map is turned about the vertical by up to this angle, as that of a light probe which is moved
    from view to view; the photographs keep the true light."""
    device: str = "auto"
    """auto, cpu or cuda."""
    seed: int = 0
    """Of worlds, cameras, probes and paths."""

    def __post_init__(self) -> None:
        if not self.objects or not set(self.objects) <= set(OBJECTS):
            raise UserError("no such objects", got=", ".join(self.objects), wanted=f"of {', '.join(OBJECTS)}")
        if self.num_views < 3 or self.num_test_views < 1 or self.size < 16 or self.light_height < 4:
            raise UserError("the data set is too small", wanted="3 views, 1 test view, 16 pixels, light maps of 4 rows")


@dataclass(frozen=True)
class _Capture:
    """One object under one light."""

    name: str
    light: EnvironmentMap
    world_from_object: np.ndarray
    training: Cameras
    test: Cameras
    """Both in the object's frame."""
    probe_turns: np.ndarray
    """Radians, per test view."""


def run(config: Config, out: Path) -> Path:
    """Render the data set into `out`; photographs that exist are kept."""
    with open_artefact(out, "render_synthetic_orb", config, {}) as artefact:
        if artefact.is_done:
            return out
        still_life = duck_still_life(config.mesh_resolution)
        total = len(config.objects) * len(LIGHTS) * (config.num_views + config.num_test_views)
        with step_progress("photographs", total) as progress:
            for name in config.objects:
                item = _centred(still_life[OBJECTS.index(name)])
                captures = [_capture(f"{name}_{scene}", light, config) for scene, light in LIGHTS.items()]
                assert item.mesh.vertex_colors is not None
                material = Material(linear_from_srgb(item.mesh.vertex_colors), item.roughness, item.metallic)
                scene = ShadedScene([(item.mesh, material)], captures[0].light, config.device)
                for capture in captures:
                    for split, cameras in (("train", capture.training), ("test", capture.test)):
                        for view in range(len(cameras)):
                            _write_photograph(out, capture, split, cameras, view, scene, config)
                            progress.advance()
                    _write_truth(out, capture, item)
                    _write_transforms(out, capture, [other for other in captures if other is not capture])
        artefact.finish({"captures": len(config.objects) * len(LIGHTS)})
    return out


def _centred(item: ProceduralObject) -> ProceduralObject:
    vertices = item.mesh.vertices
    vertices = vertices - (vertices.max(0) + vertices.min(0)) / 2
    vertices = vertices * np.float32(_OBJECT_RADIUS / np.linalg.norm(vertices, axis=1).max())
    mesh = TriangleMesh(vertices, item.mesh.faces, item.mesh.vertex_normals, item.mesh.vertex_colors)
    return ProceduralObject(mesh, item.roughness, item.metallic)


def _capture(name: str, light: Any, config: Config) -> _Capture:
    generator = numpy_generator(config.seed, "capture", name)
    world = np.eye(4)
    rotation, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    world[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    world[:3, 3] = generator.uniform(-1, 1, 3)
    shape = (_CAMERA_RADIUS, _FOV_RADIANS, config.size, config.size)
    band = (np.radians(8), np.radians(65))
    limit = np.radians(config.probe_error_degrees)
    return _Capture(
        name,
        light(config.light_height),
        world,
        spiral_cameras(config.num_views, *shape, *band),
        sphere_cameras(config.num_test_views, *shape, generator, *band),
        generator.uniform(-limit, limit, config.num_test_views),
    )


def _write_photograph(
    out: Path, capture: _Capture, split: str, cameras: Cameras, view: int, scene: ShadedScene, config: Config
) -> None:
    high, low = (out / f"blender_{kind}" / capture.name for kind in ("HDR", "LDR"))
    last = low / split / f"{view:04d}.png"
    if last.exists():
        return
    seed = derived_seed(config.seed, capture.name, split, view)
    image = scene.render(cameras, view, capture.light, config.samples_per_pixel, seed)
    alpha = np.clip(image[..., 3], 0, 1)
    _, directions = cameras.image_rays(view)
    linear_rgb = image[..., :3] + (1 - alpha[..., None]) * capture.light.radiance(directions.numpy())
    write_rgb_exr(high / split / f"{view:04d}.exr", linear_rgb.astype(np.float32), half=False)
    for folder in (high, low):
        write_png(folder / f"{split}_mask" / f"{view:04d}.png", alpha)
    write_png(last, srgb_from_linear(np.clip(linear_rgb, 0, 1)))


def _write_truth(out: Path, capture: _Capture, item: ProceduralObject) -> None:
    """The light of every test view, and the mesh with its material."""
    folder = out / "ground_truth" / capture.name
    for view, pose in enumerate(capture.test.world_from_camera):
        seen = camera_light(capture.light.rotated(float(capture.probe_turns[view])), pose)
        write_rgb_exr(folder / "env_map" / f"{view:04d}.exr", seen.linear_rgb, half=False)
    rotation, offset = capture.world_from_object[:3, :3], capture.world_from_object[:3, 3]
    mesh = item.mesh
    assert mesh.vertex_colors is not None
    vertices, normals = mesh.vertices @ rotation.T + offset, mesh.vertex_normals @ rotation.T
    lines = ["mtllib mesh.mtl", "usemtl surface"]
    lines += ["v " + " ".join(f"{x:.6f}" for x in row) for row in np.hstack([vertices, mesh.vertex_colors])]
    lines += ["vn " + " ".join(f"{x:.5f}" for x in row) for row in normals]
    lines += ["f " + " ".join(f"{x}//{x}" for x in row) for row in mesh.faces + 1]
    material = f"newmtl surface\nKd 1 1 1\nPr {item.roughness}\nPm {item.metallic}\n"
    write_bytes(folder / "mesh_blender" / "mesh.mtl", material.encode())
    write_bytes(folder / "mesh_blender" / "mesh.obj", ("\n".join(lines) + "\n").encode())


def _write_transforms(out: Path, capture: _Capture, others: Sequence[_Capture]) -> None:
    def frames(cameras: Cameras, split: str, **more: Any) -> list[dict[str, Any]]:
        poses = capture.world_from_object @ cameras.world_from_camera
        return [
            {"file_path": f"{split}/{view:04d}", "transform_matrix": pose.tolist(), **more}
            for view, pose in enumerate(poses)
        ]

    novel = [
        frame
        for other in others
        for frame in frames(other.test, "test", scene_name=other.name, camera_angle_x=_FOV_RADIANS)
    ]
    for kind in ("HDR", "LDR"):
        folder = out / f"blender_{kind}" / capture.name
        for split, cameras in (("train", capture.training), ("test", capture.test)):
            content = {"camera_angle_x": _FOV_RADIANS, "frames": frames(cameras, split)}
            write_json(folder / f"transforms_{split}.json", content)
        write_json(folder / "transforms_novel.json", {"frames": novel})
