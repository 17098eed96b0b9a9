"""The same shapes of other stuff: what keeps shape and material independent where objects are few.

Four switches: materials changed as a whole, a texture borrowed from another object, several objects in one scene, and
(at training time, `diffusion.augmentation`) random materials composited from the cues. None is in the paper, which has
150,000 objects. What was done to an item is written into its metadata by name.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from illuminerf.cues.materials import Material, Parts
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError

_MOST_OTHERS = 2
_PLACEMENT_TRIES = 12


@dataclass(frozen=True)
class MaterialVariation:
    """How often an item is changed, and how; every probability 0 leaves objects as they are."""

    change_probability: float = 0.5
    """Roughness, metallicity and colour replaced or tinted as a whole, see `changed`."""
    swap_probability: float = 0.15
    """Another object's texture, projected onto this one from six sides, see `swapped`."""
    compose_probability: float = 0.15
    """One or two other objects beside this one, see `composed`."""

    def __post_init__(self) -> None:
        probabilities = (self.change_probability, self.swap_probability, self.compose_probability)
        if not all(0 <= p <= 1 for p in probabilities):
            raise UserError(
                "probabilities of material variations are out of range",
                got=", ".join(f"{p:g}" for p in probabilities),
                wanted="values in [0, 1]",
            )

    @staticmethod
    def none() -> "MaterialVariation":
        """Objects as they are, as in the paper."""
        return MaterialVariation(0.0, 0.0, 0.0)


DrawOther = Callable[[np.random.Generator], tuple[str, Parts] | None]


def varied(
    parts: Parts, variation: MaterialVariation, generator: np.random.Generator, draw_other: DrawOther
) -> tuple[Parts, list[str], list[str]]:
    """Vary an object at random.

    Args:
        parts: the object, in the unit sphere.
        variation: how often.
        generator: draws everything.
        draw_other: gives another object's name and parts, or None where the one that was drawn is broken.

    Returns:
        The parts, again in the unit sphere; what was done, for example ["texture of crate", "roughness"]; and the
        names of the other objects that were used.
    """
    done: list[str] = []
    donors: list[str] = []
    # always drawn, so that switching one variation off leaves the others as they were
    changes, swaps, composes = generator.random(3) < (
        variation.change_probability,
        variation.swap_probability,
        variation.compose_probability,
    )
    own, swapping, composing = generator.spawn(3)
    if swaps and (donor := draw_other(swapping)) is not None:
        texture = next((material for _, material in donor[1] if material.is_textured), None)
        if texture is not None:
            parts = swapped(parts, texture)
            done.append(f"texture of {donor[0]}")
            donors.append(donor[0])
    if changes:
        parts, names = changed(parts, own)
        done += names
    if composes:
        others = [draw_other(composing) for _ in range(int(composing.integers(1, _MOST_OTHERS + 1)))]
        found = [other for other in others if other is not None]
        if found:
            parts = composed([parts, *(other for _, other in found)], composing)
            done.append("beside " + ", ".join(name for name, _ in found))
            donors += [name for name, _ in found]
    return parts, done, donors


def changed(parts: Parts, generator: np.random.Generator) -> tuple[Parts, list[str]]:
    """Roughness and metallicity replaced, base colour tinted or replaced, each drawn on its own."""
    new_roughness = float(generator.uniform(0.08, 0.95)) if generator.random() < 0.6 else None
    new_metallic = float(generator.random() < 0.5) if generator.random() < 0.4 else None
    tint = generator.uniform(0.3, 1.0, 3) if generator.random() < 0.5 else None
    flat_color = tuple(generator.uniform(0.02, 0.95, 3)) if generator.random() < 0.25 else None
    names = [
        name
        for name, value in (
            ("roughness", new_roughness),
            ("metallic", new_metallic),
            ("tint", None if flat_color is not None else tint),
            ("one colour", flat_color),
        )
        if value is not None
    ]
    return [
        (mesh, _replaced(material, new_roughness, new_metallic, tint, flat_color)) for mesh, material in parts
    ], names


def _replaced(
    material: Material,
    new_roughness: float | None,
    new_metallic: float | None,
    tint: np.ndarray | None,
    flat_color: tuple[float, ...] | None,
) -> Material:
    color = np.asarray(material.base_color, np.float32)
    if flat_color is not None:
        color = np.broadcast_to(np.asarray(flat_color, np.float32), color.shape)
    elif tint is not None:
        color = color * tint.astype(np.float32)
    return Material(
        np.ascontiguousarray(color),
        material.roughness if new_roughness is None else new_roughness,
        material.metallic if new_metallic is None else new_metallic,
        material.uv,
        material.normal_map,
    )


def swapped(parts: Parts, texture: Material) -> Parts:
    """The shapes in another object's texture, projected along the axis that each face looks along most.

    Args:
        parts: shapes in the unit sphere.
        texture: a textured material; its own uv coordinates are not used.
    """
    return [_projected(mesh, texture) for mesh, _ in parts]


def _projected(mesh: TriangleMesh, texture: Material) -> tuple[TriangleMesh, Material]:
    corners = mesh.vertices[mesh.faces]
    facing = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).argmax(1)
    # (x, y), (y, z) or (x, z) for faces that look along z, x or y
    axes = np.stack([np.where(facing == 0, 1, 0), np.where(facing == 2, 1, 2)], -1)
    uv = np.take_along_axis(corners, np.broadcast_to(axes[:, None], (len(axes), 3, 2)), 2)
    separate = TriangleMesh(
        np.ascontiguousarray(corners.reshape(-1, 3)),
        np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3),
        np.ascontiguousarray(mesh.vertex_normals[mesh.faces].reshape(-1, 3)),
    )
    coordinates = np.ascontiguousarray((0.5 + 0.5 * uv.reshape(-1, 2)).astype(np.float32))
    return separate, Material(texture.base_color, texture.roughness, texture.metallic, coordinates)


def composed(objects: list[Parts], generator: np.random.Generator) -> Parts:
    """Several objects side by side on one ground, turned and scaled at random, together in the unit sphere.

    Bounding cylinders do not overlap, but objects stand close enough to shade and reflect each other.
    """
    placed: Parts = []
    centres: list[tuple[np.ndarray, float]] = []
    for index, parts in enumerate(objects):
        scale = 1.0 if index == 0 else float(generator.uniform(0.4, 0.9))
        turn = float(generator.uniform(0, 2 * np.pi))
        rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        moved = [(_moved(mesh, rotation * scale, np.zeros(3), rotation), material) for mesh, material in parts]
        used = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh, _ in moved])
        middle = (used[:, :2].min(0) + used[:, :2].max(0)) / 2
        radius = float(np.linalg.norm(used[:, :2] - middle, axis=1).max())
        at = _free_place(centres, radius, generator)
        offset = np.array([*(at - middle), -used[:, 2].min()])
        placed += [(_moved(mesh, np.eye(3), offset, np.eye(3)), material) for mesh, material in moved]
        centres.append((at, radius))
    return in_unit_sphere(placed)


def _free_place(centres: list[tuple[np.ndarray, float]], radius: float, generator: np.random.Generator) -> np.ndarray:
    """A spot beside the first circle that overlaps none of `centres`, the nearest of a few random ones."""
    if not centres:
        return np.zeros(2)
    first, first_radius = centres[0]
    for _ in range(_PLACEMENT_TRIES):
        angle = float(generator.uniform(0, 2 * np.pi))
        at = first + 1.05 * (first_radius + radius) * np.array([np.cos(angle), np.sin(angle)])
        if all(np.linalg.norm(at - centre) >= radius + other for centre, other in centres):
            return at
    reach = max(float(np.linalg.norm(centre - first)) + other for centre, other in centres)
    return first + np.array([reach + radius, 0.0])


def _moved(mesh: TriangleMesh, matrix: np.ndarray, offset: np.ndarray, rotation: np.ndarray) -> TriangleMesh:
    return TriangleMesh(
        (mesh.vertices @ matrix.T + offset).astype(np.float32),
        mesh.faces,
        (mesh.vertex_normals @ rotation.T).astype(np.float32),
    )


def in_unit_sphere(parts: Parts) -> Parts:
    """Centred by the bounding box and scaled so that the farthest point lies on the unit sphere."""
    used = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh, _ in parts]).astype(np.float64)
    centre = (used.min(0) + used.max(0)) / 2
    radius = float(np.linalg.norm(used - centre, axis=1).max())
    return [(_moved(mesh, np.eye(3) / radius, -centre / radius, np.eye(3)), material) for mesh, material in parts]
