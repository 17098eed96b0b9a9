"""Dented geometry for the cues of training items: what an estimated mesh is, and a modeller's is not.

At inference the cues and the photographs' own shading come from a fitted mesh, whose dents cancel where a photograph is
divided by one and multiplied by the other. A model that has seen exact cues only does not know that. So a share of the
items is rendered with cues of a dented copy, while targets and G-buffer stay the object's own.
Deviation: the paper's training cues come from the objects as they are.
"""

from dataclasses import dataclass

import numpy as np

from illuminerf.cues.texture_baking import affordable_edge, split_to_edge
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError

_NUM_WAVES = 48
_MAX_EDGE = 0.04
_MAX_FACES = 60_000


@dataclass(frozen=True)
class DentVariation:
    """How often and how deeply the geometry of cues is dented."""

    probability: float = 0.5
    """Share of items whose cues are rendered from dented geometry."""
    max_tilt_degrees: float = 9.0
    """Each size of dents tilts normals by an RMS angle drawn between 0 and this."""
    sizes: tuple[float, ...] = (0.15, 0.05)
    """Lengths over which dents vary, in a scene of radius 1."""

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1 or not 0 <= self.max_tilt_degrees <= 45:
            raise UserError(
                "dents are out of range",
                got=f"probability {self.probability:g}, {self.max_tilt_degrees:g} degrees",
                wanted="a probability in [0, 1] and 0 to 45 degrees",
            )
        if not self.sizes or min(self.sizes) <= 0:
            raise UserError("dents need sizes above 0", got=str(self.sizes))


def drawn_tilts(variation: DentVariation, generator: np.random.Generator) -> tuple[float, ...]:
    """RMS tilt of each size in degrees for one item; empty where it stays exact."""
    chance, tilts = generator.random(), generator.uniform(0, variation.max_tilt_degrees, len(variation.sizes))
    return tuple(float(tilt) for tilt in tilts) if chance < variation.probability else ()


def dented(
    mesh: TriangleMesh, sizes: tuple[float, ...], tilts_degrees: tuple[float, ...], generator: np.random.Generator
) -> TriangleMesh:
    """Push a mesh about by a smooth random field of the position, so that vertices in one place stay in one place.

    Args:
        mesh: within the unit sphere; long edges are split first.
        sizes: lengths over which the field varies.
        tilts_degrees: by how much, RMS, each size tilts a normal.
        generator: draws the field.
    """
    corners = np.concatenate([mesh.vertices, mesh.vertex_normals], -1)[mesh.faces].astype(np.float32)
    corners = split_to_edge(corners, affordable_edge(corners[..., :3], _MAX_EDGE, _MAX_FACES))
    points, inverse = np.unique(corners.reshape(-1, 6), axis=0, return_inverse=True)
    positions, normals = points[:, :3].astype(np.float64), points[:, 3:].astype(np.float64)
    moved, jacobian = positions.copy(), np.broadcast_to(np.eye(3), (len(points), 3, 3)).copy()
    for size, tilt in zip(sizes, tilts_degrees, strict=True):
        waves = generator.normal(size=(_NUM_WAVES, 3)) / size
        phases = generator.uniform(0, 2 * np.pi, _NUM_WAVES)
        # a gradient of RMS tan(tilt) along the normal tilts it by that much in either tangent direction
        directions = generator.normal(size=(_NUM_WAVES, 3))
        amplitude = np.tan(np.radians(tilt)) * size * np.sqrt(2 / _NUM_WAVES)
        angle = positions @ waves.T + phases
        moved += amplitude * np.cos(angle) @ directions
        jacobian -= amplitude * np.einsum("pw,wi,wj->pij", np.sin(angle), directions, waves)
    turned = np.linalg.solve(jacobian.transpose(0, 2, 1), normals[..., None])[..., 0]
    turned /= np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-12)
    faces = inverse.reshape(-1, 3).astype(np.int32)
    return TriangleMesh(moved.astype(np.float32), faces, turned.astype(np.float32))
