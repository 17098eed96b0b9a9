"""Points on a mesh: the colours that photographs show there, and how much light reaches them from every direction."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from illuminerf.cues.mitsuba_scene import mitsuba_mesh
from illuminerf.cues.mitsuba_variant import load_mitsuba
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import linear_from_srgb
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.views import Views
from illuminerf.workflow.errors import UserError

_RAYS_PER_PASS = 2**20
_OFFSET = 4e-3  # of the unit ball: rays start this far above the surface, beyond its dents
_POINTS_FOR_NORMALS = 30_000
_LEAST_COSINE = 0.2  # photographs that see a point at a flatter angle are not asked
_OPAQUE = 0.98
CLIPPED_SRGB = 0.985
"""Values above say only that the light was brighter than the photograph can show."""


class RayCaster:
    """Where rays hit a mesh.

    Args:
        mesh: the object.
        device: auto, cpu or cuda.
    """

    def __init__(self, mesh: TriangleMesh, device: str = "auto") -> None:
        self._mitsuba = load_mitsuba(device)
        shape = mitsuba_mesh(self._mitsuba, "mesh", mesh.vertices, mesh.faces, {"type": "diffuse"})
        self._scene: Any = self._mitsuba.load_dict({"type": "scene", "mesh": shape})

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """How far rays go, float32 [rays], infinite where they hit nothing; origins and unit directions [rays, 3]."""
        mi, is_scalar = self._mitsuba, self._mitsuba.variant().startswith("scalar")
        found = np.zeros(len(origins), np.float32)
        for first in range(0, len(origins), _RAYS_PER_PASS):
            part = slice(first, first + _RAYS_PER_PASS)
            starts, toward = (np.ascontiguousarray(a[part], np.float32) for a in (origins, directions))
            if is_scalar:
                rays = zip(starts.tolist(), toward.tolist(), strict=True)
                found[part] = [self._distance(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))) for o, d in rays]
            else:
                found[part] = self._distance(mi.Ray3f(mi.Point3f(*starts.T), mi.Vector3f(*toward.T)))
        return found

    def _distance(self, ray: Any) -> Any:
        return self._scene.ray_intersect_preliminary(ray).t


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a mesh.

    Attributes:
        positions: float32 [points, 3], world.
        normals: float32 [points, 3], unit, outward.
    """

    positions: np.ndarray
    normals: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: np.ndarray) -> "SurfacePoints":
        return SurfacePoints(self.positions[index], self.normals[index])


@dataclass(frozen=True)
class ColorGathering:
    """Which points of a mesh are looked at, and how their colours are read from photographs."""

    num_points: int = 6000
    """Points to keep."""
    candidates_per_point: int = 3
    """Points drawn for every one to keep; those that photographs do not show well are dropped."""
    normal_radius: float = 0.05
    """Normals are averaged over the surface within this distance, in radii of the unit ball, which irons out dents."""
    quantile: float = 0.25
    """Which of the colours that a point shows in different photographs counts; low ones leave highlights out."""
    least_views: int = 2
    """Photographs that must show a point (all of them, where there are fewer)."""

    def __post_init__(self) -> None:
        if min(self.num_points, self.candidates_per_point, self.least_views) < 1:
            raise UserError("numbers of points and views must be positive", got=str(self))
        if not 0 <= self.quantile <= 1 or not 0 < self.normal_radius <= 0.2:
            raise UserError(
                "the quantile or the radius of normals is out of range",
                got=f"{self.quantile:g} and {self.normal_radius:g}",
                wanted="up to 1 and up to 0.2",
            )


def seen_points(
    mesh: TriangleMesh,
    views: Views,
    caster: RayCaster,
    config: ColorGathering,
    generator: np.random.Generator,
) -> tuple[SurfacePoints, np.ndarray]:
    """Points that photographs show well, and their linear colours, float32 [points, 3].

    Args:
        mesh: the object in the world of the cameras.
        views: photographs.
        caster: of the same mesh.
        config: the settings.
        generator: draws the points.
    """
    count = config.num_points * config.candidates_per_point
    candidates = surface_points(mesh, count, config.normal_radius, generator)
    colors = seen_colors(candidates, views, caster, config.quantile, min(config.least_views, len(views)))
    kept = np.flatnonzero(np.isfinite(colors).all(-1))[: config.num_points]
    return candidates[kept], colors[kept]


def surface_points(mesh: TriangleMesh, count: int, radius: float, generator: np.random.Generator) -> SurfacePoints:
    """Points spread evenly over the surface, with the mean normal of the surface around each.

    Args:
        mesh: the object.
        count: number of points.
        radius: of the neighbourhood whose normals are averaged, which irons out small dents.
        generator: draws the points.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_areas = np.linalg.norm(cross, axis=1)
    num_drawn = max(count, _POINTS_FOR_NORMALS)
    face = generator.choice(len(cross), num_drawn, p=double_areas / double_areas.sum())
    u, v = np.sqrt(generator.random(num_drawn)), generator.random(num_drawn)
    weights = np.stack([1 - u, u * (1 - v), u * v], -1)
    positions = (corners[face] * weights[..., None]).sum(1)
    normals = _averaged(positions, cross[face] / double_areas[face, None], radius)
    return SurfacePoints(positions[:count].astype(np.float32), normals[:count].astype(np.float32))


def _averaged(positions: np.ndarray, normals: np.ndarray, radius: float) -> np.ndarray:
    """Unit means of the normals of points within `radius` that look to the same side as the point's own."""
    first, second = cKDTree(positions).query_pairs(radius, output_type="ndarray").T
    same_side = (normals[first] * normals[second]).sum(1) > 0
    first, second = first[same_side], second[same_side]
    ones, shape = np.ones(len(first)), (len(positions), len(positions))
    near = csr_matrix((ones, (first, second)), shape=shape)
    total = normals + near @ normals + near.T @ normals
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def seen_colors(
    points: SurfacePoints, views: Views, caster: RayCaster, quantile: float, least_views: int
) -> np.ndarray:
    """What photographs show at points.

    Args:
        points: on the surface.
        views: photographs.
        caster: of the same mesh.
        quantile: which of the colours that different photographs show, per channel: low ones leave highlights out.
        least_views: points seen by fewer are left out.

    Returns:
        Linear colours, float32 [points, 3]; NaN where too few photographs see the point, or it is overexposed in them.
    """
    colors = np.full((len(views), len(points), 3), np.nan, np.float32)
    for view in range(len(views)):
        seen = sightings(points, views, view, caster)
        colors[view, seen.index] = seen.srgb
    enough = np.isfinite(colors[..., 0]).sum(0) >= max(least_views, 1)
    result = np.full((len(points), 3), np.nan, np.float32)
    # colours in sRGB sort as linear ones do
    if enough.any():
        result[enough] = np.nanquantile(colors[:, enough], quantile, axis=0)
    result[(result > CLIPPED_SRGB).any(-1)] = np.nan
    return linear_from_srgb(result)


@dataclass(frozen=True)
class Sightings:
    """Points that a photograph shows well.

    Attributes:
        index: int64 [seen], of the points.
        pixels: float64 [seen, 2], where they are seen (x, y).
        srgb: float32 [seen, 3].
    """

    index: np.ndarray
    pixels: np.ndarray
    srgb: np.ndarray


def sightings(points: SurfacePoints, views: Views, view: int, caster: RayCaster) -> Sightings:
    """The points that are turned to the camera of `view`, inside its mask and not hidden by the mesh."""
    pixels, depth = (values[0] for values in views.cameras[view].project(points.positions))
    toward = views.cameras.positions[view] - points.positions
    toward /= np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-9)
    is_turned = (toward * points.normals).sum(-1) > _LEAST_COSINE
    size = np.array([views.cameras.width, views.cameras.height])
    is_inside = ((pixels > 0.5) & (pixels < size - 0.5)).all(-1)
    index = np.flatnonzero((depth > 0) & is_turned & is_inside)
    colour = bilinear(np.dstack([views.srgb[view], views.alpha[view]]), pixels[index])
    is_opaque = colour[:, 3] > _OPAQUE
    index, srgb = index[is_opaque], colour[is_opaque, :3]
    starts = points.positions[index] + _OFFSET * points.normals[index]
    is_free = np.isinf(caster.distances(starts, toward[index]))
    return Sightings(index[is_free], pixels[index[is_free]], srgb[is_free])


def bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Values [points, channels] of an image [height, width, channels] at image points (x, y) [points, 2] inside it."""
    at = pixels - 0.5
    corner = np.minimum(np.floor(at).astype(int), np.array(image.shape[1::-1]) - 2)
    x, y = corner.T
    u, v = (at - corner).T[..., None]
    upper = (1 - u) * image[y, x] + u * image[y, x + 1]
    lower = (1 - u) * image[y + 1, x] + u * image[y + 1, x + 1]
    return (1 - v) * upper + v * lower


def light_transport(points: SurfacePoints, caster: RayCaster, height: int) -> np.ndarray:
    """Diffuse shading per radiance of every texel of an equirectangular map, without interreflections.

    Args:
        points: on the surface.
        caster: of the same mesh.
        height: rows of the map.

    Returns:
        float32 [points, height * 2 * height]: its product with radiance is irradiance over pi, 1 in a furnace of 1.
    """
    blank = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32))
    directions = blank.directions().reshape(-1, 3)
    solid_angles = np.broadcast_to(blank.solid_angles()[..., 0], (height, 2 * height)).ravel()
    cosine = points.normals @ directions.T
    point, texel = np.nonzero(cosine > 0)
    starts = points.positions[point] + _OFFSET * points.normals[point]
    is_free = np.isinf(caster.distances(starts, directions[texel]))
    transport = np.zeros(cosine.shape, np.float32)
    transport[point, texel] = np.where(is_free, cosine[point, texel] * solid_angles[texel] / np.pi, 0)
    return transport


def interreflection(
    points: SurfacePoints, caster: RayCaster, rays_per_point: int, generator: np.random.Generator
) -> csr_matrix:
    """Diffuse shading per radiance of the other points, [points, points]; rows sum to what a point sees of the mesh.

    Args:
        points: on the surface; what a ray hits counts as the nearest of them.
        caster: of the same mesh.
        rays_per_point: cosine-weighted directions to look into.
        generator: draws them.
    """
    num_points = len(points)
    directions = generator.normal(size=(num_points, rays_per_point, 3))
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True) + points.normals[:, None]
    directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).reshape(-1, 3)
    starts = np.repeat(points.positions + _OFFSET * points.normals, rays_per_point, 0)
    distance = caster.distances(starts, directions)
    hit = np.flatnonzero(np.isfinite(distance))
    seen = cKDTree(points.positions).query(starts[hit] + distance[hit, None] * directions[hit])[1]
    shares = np.full(len(hit), 1 / rays_per_point)
    return csr_matrix((shares, (hit // rays_per_point, seen)), shape=(num_points, num_points))
