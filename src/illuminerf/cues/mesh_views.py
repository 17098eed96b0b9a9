"""What cameras see of a bare mesh: its normals pixel by pixel, and the part of its surface that is seen at all."""

import numpy as np

from illuminerf.cues.mitsuba_scene import MitsubaScene, mitsuba_mesh
from illuminerf.cues.mitsuba_variant import load_mitsuba
from illuminerf.cues.shading import toward_camera
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.surfels import Surfels, thinned
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

_NORMAL_SAMPLES = 16
_AOVS = "cover:albedo,normal:sh_normal,flat:geo_normal,position:position"


class MeshScene:
    """A mesh to look at.

    Args:
        mesh: in the world of the cameras.
        is_smooth: normals are interpolated between the vertices' own, as in specular cues; else they are the faces'.
        device: auto, cpu or cuda.
    """

    def __init__(self, mesh: TriangleMesh, is_smooth: bool = True, device: str = "auto") -> None:
        mi = load_mitsuba(device)
        white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
        normals = mesh.vertex_normals if is_smooth else None
        shape = mitsuba_mesh(mi, "mesh", mesh.vertices, mesh.faces, white, normals)
        self._scene = MitsubaScene({"mesh": shape}, EnvironmentMap(np.ones((4, 8, 3), np.float32)), device)

    def normals(self, cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals towards the camera, float32 [height, width, 3], 0 where nothing is seen, and coverage."""
        found = self._scene.render_aovs(_AOVS, cameras, view, _NORMAL_SAMPLES, 0)
        _, directions = cameras.image_rays(view)
        coverage = np.clip(found[..., 0], 0, 1)
        normals = toward_camera(found[..., 3:6], found[..., 6:9], directions.numpy())
        return normals * (coverage > 0)[..., None], coverage

    def hits(self, cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where one ray through every pixel meets the mesh, float32 [hits, 3], its unit normals there and those of its
        faces, both on the side of the faces that the camera sees."""
        found = self._scene.render_aovs(_AOVS, cameras, view, 1, 0)
        found = found[found[..., 0] > 0.5]
        normals, flat, positions = found[:, 3:6], found[:, 6:9], found[:, 9:12]
        leaving = ((positions - cameras.positions[view]) * flat).sum(-1, keepdims=True) > 0
        outward = np.where(leaving, -flat, flat)
        normals = np.where((normals * outward).sum(-1, keepdims=True) < 0, -normals, normals)
        lengths = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        return positions, (normals / lengths).astype(np.float32), outward.astype(np.float32)

    def depths(self, cameras: Cameras, view: int) -> np.ndarray:
        """How far one ray through every pixel goes, float32 [height, width]; infinite where it meets nothing."""
        found = self._scene.render_aovs(_AOVS, cameras, view, 1, 0)
        away = np.linalg.norm(found[..., 9:12] - cameras.positions[view], axis=-1)
        return np.where(found[..., 0] > 0.5, away, np.inf).astype(np.float32)


def seen_surfels(
    mesh: TriangleMesh, cameras: Cameras, spacing: float, size: int, device: str = "auto"
) -> tuple[Surfels, np.ndarray]:
    """The part of a mesh's surface that some camera sees, evenly sampled: discs along its faces, and the unit normals
    [surfels, 3] interpolated between the vertices' there.

    Rays of all cameras are cast, so what is hidden inside a model does not count, nor do doubled faces.

    Args:
        mesh: in the world of the cameras.
        cameras: who looks.
        spacing: between the points, in world units.
        size: rays along the longer side of every image.
        device: auto, cpu or cuda.

    Raises:
        UserError: no camera sees the mesh.
    """
    scene = MeshScene(mesh, device=device)
    factor = size / max(cameras.height, cameras.width)
    cameras = cameras.resized(max(1, round(cameras.height * factor)), max(1, round(cameras.width * factor)))
    found = np.zeros((0, 9), np.float32)
    for view in track(range(len(cameras)), "cast rays"):
        found = np.concatenate([found, np.concatenate(scene.hits(cameras, view), -1)])
        found = found[thinned(found[:, :3], found[:, 6:], spacing)]
    if not len(found):
        raise UserError("no camera sees the mesh", fix="check that mesh and cameras are in the same world")
    return Surfels(found[:, :3].copy(), found[:, 6:].copy(), spacing), found[:, 3:6].copy()
