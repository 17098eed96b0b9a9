"""Objects and lights made from formulas: what the bundled demo capture shows.

Signed distances are negative inside. Points are float [..., 3] in a z-up world; the whole still life fits into
the unit ball.
"""

from dataclasses import dataclass

import numpy as np
from skimage.measure import marching_cubes

from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.meshes import TriangleMesh


@dataclass(frozen=True)
class ProceduralObject:
    """A coloured mesh with one roughness and metalness.

    Attributes:
        mesh: its vertex_colors are sRGB base colours.
        roughness: Blender's roughness r (alpha = r * r).
        metallic: 0 (dielectric) to 1 (metal).
    """

    mesh: TriangleMesh
    roughness: float
    metallic: float


def duck_still_life(resolution: int = 160) -> list[ProceduralObject]:
    """A glazed duck on a wooden board beside a brushed metal ball and a striped cup."""
    return [
        ProceduralObject(_meshed(_duck, _duck_color, resolution), roughness=0.22, metallic=0.0),
        ProceduralObject(_meshed(_board, _board_color, resolution), roughness=0.55, metallic=0.0),
        ProceduralObject(_meshed(_ball, _ball_color, resolution), roughness=0.25, metallic=1.0),
        ProceduralObject(_meshed(_cup, _cup_color, resolution), roughness=0.35, metallic=0.0),
    ]


def studio_light(height: int = 64) -> EnvironmentMap:
    """A grey room with a large soft box in front, a smaller warm one at the side and a pale floor."""
    blank = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32), "studio")
    directions = blank.directions()
    image = np.full(directions.shape, 0.32) + 0.18 * directions[..., 2:]
    image = image + _lobe(directions, azimuth=0.5, elevation=0.7, degrees=24.0)[..., None] * np.array([6.0, 6.2, 6.6])
    image = image + _lobe(directions, azimuth=-2.0, elevation=0.35, degrees=16.0)[..., None] * np.array([5.0, 3.9, 2.6])
    return EnvironmentMap(np.maximum(image, 0.02).astype(np.float32), "studio")


def evening_light(height: int = 64) -> EnvironmentMap:
    """A low orange sun from behind the studio's dark side, a blue sky above and brown ground below."""
    blank = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32), "evening")
    directions = blank.directions()
    up = directions[..., 2:]
    sky = np.array([0.38, 0.56, 0.98]) * (0.35 + 0.65 * np.maximum(up, 0))
    glow = _lobe(directions, azimuth=2.6, elevation=0.1, degrees=40.0)[..., None] * np.array([1.4, 0.65, 0.26])
    sun = _lobe(directions, azimuth=2.6, elevation=0.42, degrees=7.0)[..., None] * np.array([95.0, 62.0, 32.0])
    ground = np.array([0.17, 0.13, 0.09])
    image = np.where(up > 0, sky, ground) + glow + sun
    return EnvironmentMap(image.astype(np.float32), "evening")


def _lobe(directions: np.ndarray, azimuth: float, elevation: float, degrees: float) -> np.ndarray:
    """A disc of light with a soft edge, 1 in its middle."""
    centre = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    angle = np.degrees(np.arccos(np.clip(directions @ centre, -1, 1)))
    return 1 / (1 + np.exp(np.clip((angle - degrees) / (0.08 * degrees), -50, 50)))


def _meshed(distance, color, resolution: int) -> TriangleMesh:  # type: ignore[no-untyped-def]
    axis = np.linspace(-1, 1, resolution)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = distance(grid)
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(axis[1] - axis[0],) * 3)
    vertices = vertices - 1
    step = 1e-4
    offsets = step * np.eye(3)
    gradient = np.stack([distance(vertices + o) - distance(vertices - o) for o in offsets], -1)
    normals = gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-12)
    return TriangleMesh(
        vertices.astype(np.float32),
        np.ascontiguousarray(faces, np.int32),
        normals.astype(np.float32),
        np.clip(color(vertices), 0, 1).astype(np.float32),
    )


def _ellipsoid(p: np.ndarray, centre: tuple[float, ...], radii: tuple[float, ...]) -> np.ndarray:
    q = (p - np.array(centre)) / np.array(radii)
    length = np.linalg.norm(q, axis=-1)
    slope = np.linalg.norm(q / np.array(radii), axis=-1)
    return length * (length - 1) / np.maximum(slope, 1e-9)


def _blend(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Smooth union."""
    h = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return b + (a - b) * h - width * h * (1 - h)


_HEAD, _BEAK = (0.22, 0.10, 0.37), (0.43, 0.10, 0.33)


def _duck(p: np.ndarray) -> np.ndarray:
    body = _ellipsoid(p, (0.0, 0.10, -0.10), (0.42, 0.29, 0.26))
    tail = _ellipsoid(p, (-0.38, 0.10, 0.08), (0.14, 0.09, 0.13))
    wings = np.minimum(
        _ellipsoid(p, (-0.06, 0.37, -0.03), (0.22, 0.06, 0.12)),
        _ellipsoid(p, (-0.06, -0.17, -0.03), (0.22, 0.06, 0.12)),
    )
    head = _ellipsoid(p, _HEAD, (0.21, 0.20, 0.20))
    beak = _ellipsoid(p, _BEAK, (0.11, 0.09, 0.035))
    return _blend(_blend(_blend(_blend(body, tail, 0.12), wings, 0.05), head, 0.12), beak, 0.02)


def _duck_color(p: np.ndarray) -> np.ndarray:
    yellow, orange, black = (
        np.array([0.95, 0.78, 0.16]),
        np.array([0.92, 0.42, 0.10]),
        np.array([0.06, 0.05, 0.05]),
    )
    color = np.broadcast_to(yellow, p.shape).copy()
    color[_ellipsoid(p, _BEAK, (0.125, 0.11, 0.05)) < 0] = orange
    for side in (-1, 1):
        eye = np.linalg.norm(p - np.array([0.345, 0.10 + side * 0.115, 0.44]), axis=-1)
        color[eye < 0.055] = black
    return color


def _board(p: np.ndarray) -> np.ndarray:
    ring = np.linalg.norm(p[..., :2], axis=-1) - 0.78
    q = np.stack([ring, np.abs(p[..., 2] + 0.42) - 0.045], -1)
    outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
    return outside + np.minimum(q.max(-1), 0) - 0.02


def _board_color(p: np.ndarray) -> np.ndarray:
    ring = np.linalg.norm(p[..., :2] - np.array([0.9, -0.5]), axis=-1) + 0.03 * np.sin(7 * p[..., 0] + 3 * p[..., 1])
    grain = 0.5 + 0.5 * np.sin(48 * ring)
    return np.array([0.50, 0.31, 0.17]) + grain[..., None] * np.array([0.16, 0.11, 0.07])


def _ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p - np.array([0.28, -0.45, -0.18]), axis=-1) - 0.18


def _ball_color(p: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.array([0.90, 0.86, 0.80]), p.shape)


def _cup(p: np.ndarray) -> np.ndarray:
    q = p - np.array([-0.36, -0.42, -0.19])
    radius = np.linalg.norm(q[..., :2], axis=-1) - 0.16 - 0.12 * q[..., 2]
    wall = np.maximum(np.abs(radius) - 0.022, np.abs(q[..., 2]) - 0.185)
    floor = np.maximum(radius, np.abs(q[..., 2] + 0.165) - 0.02)
    return _blend(wall, floor, 0.01) - 0.008


def _cup_color(p: np.ndarray) -> np.ndarray:
    stripe = (np.sin(34 * (p[..., 2] + 0.4)) > 0.2)[..., None]
    return np.where(stripe, np.array([0.12, 0.32, 0.62]), np.array([0.90, 0.89, 0.85]))
