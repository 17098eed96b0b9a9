"""Objects from files, as parts with metallic-roughness materials in the unit sphere.

Formats: .glb and .gltf (any unit; y-up by definition), .obj with .mtl, .ply with vertex colours. What cannot be used
raises `BrokenObject`, whose `reason` can be counted. Readers of single formats are in `gltf_scenes`, `obj_files` and
`ply_files`; here their parts become meshes and materials.
"""

import struct
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.gltf_scenes import read_gltf
from illuminerf.cues.materials import Material, Parts
from illuminerf.cues.obj_files import read_obj
from illuminerf.cues.object_geometry import Bounds, merged_by_material, normalized
from illuminerf.cues.object_textures import MaterialMaker, lets_light_through, transparent
from illuminerf.cues.ply_files import read_ply
from illuminerf.cues.raw_objects import RawMaterial, RawPart, ReadingLimits
from illuminerf.cues.texture_baking import baked_with_tint
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError

OBJECT_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
UpAxis = Literal["auto", "y", "z"]

# rows are our axes in y-up ones: (x, y, z) of such a file becomes (x, -z, y)
_WORLD_FROM_Y_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)
_OPAQUE_VERTICES = 250 / 255
# What no check foresaw in a stranger's file still must not stop a run over many. OSError and MemoryError are not
# among it: they tell of this machine.
_BAD_CONTENT = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, struct.error)


@dataclass(frozen=True)
class MissingMaterials:
    """What objects without colours or without materials are made of (paper, supplement "Training Data Processing").

    An object that only has geometry gets one random albedo. Where it names no material at all, a glossy lobe of the
    same colour is mixed in; where its materials say nothing, it is diffuse.
    Deviation: the paper mixes Blender's Glossy and Diffuse closures. In the metallic-roughness model the mix of a
    glossy and a diffuse lobe of one colour is what metallic means, so the mixing factor becomes metallic; the
    dielectric highlight of the diffuse side, which Blender's closure has not, stays.
    """

    min_albedo: float = 0.0
    """Least linear albedo of each channel (paper: 0)."""
    max_albedo: float = 1.0
    """Greatest linear albedo of each channel (paper: 1)."""
    min_roughness: float = 0.02
    """Least roughness of the glossy lobe, in Blender's slot (paper: 0.02)."""
    max_roughness: float = 0.5
    """Greatest roughness of the glossy lobe (paper: 0.5)."""
    min_mix: float = 0.0
    """Least share of the glossy lobe (paper: 0)."""
    max_mix: float = 1.0
    """Greatest share of the glossy lobe (paper: 1)."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("albedo", self.min_albedo, self.max_albedo),
            ("roughness", self.min_roughness, self.max_roughness),
            ("mix", self.min_mix, self.max_mix),
        ):
            if not 0 <= low <= high <= 1:
                raise UserError(f"the {name} of missing materials is out of range", wanted="0 <= least <= most <= 1")

    def draw(self, generator: np.random.Generator) -> Material:
        """One glossy material; always five draws, so that seeds mean the same for every object."""
        albedo = generator.uniform(self.min_albedo, self.max_albedo, 3)
        roughness = generator.uniform(self.min_roughness, self.max_roughness)
        mix = generator.uniform(self.min_mix, self.max_mix)
        return Material((float(albedo[0]), float(albedo[1]), float(albedo[2])), float(roughness), float(mix))


@dataclass(frozen=True)
class ObjectReading:
    """How object files are read."""

    up_axis: UpAxis = "auto"
    """Which axis of OBJ and PLY files points up; "auto": y for OBJ, as most exporters write it, z for PLY, as scanners
    do. glTF is y-up by definition."""
    limits: ReadingLimits = field(default_factory=ReadingLimits)
    """What is too large."""
    missing: MissingMaterials = field(default_factory=MissingMaterials)
    """What objects without materials are made of."""


def load_object(path: Path, generator: np.random.Generator, config: ObjectReading | None = None) -> Parts:
    """Read an object, z-up, its bounding box centred, scaled into the unit sphere.

    Args:
        path: a .glb, .gltf, .obj or .ply file.
        generator: draws what materials the file lacks.
        config: limits, axes and missing materials.

    Raises:
        BrokenObject: the object cannot be used; `reason` says why.
        UserError: the file cannot be opened or read, for which the disk is to blame and not the object.
    """
    config = config or ObjectReading()
    return _loaded(path, _world_from_file(path, config.up_axis), generator, config)[0]


def load_object_in_place(path: Path, generator: np.random.Generator, config: ObjectReading | None = None) -> Parts:
    """As `load_object`, but axes, place and size are the file's own, as of a mesh that belongs to given cameras."""
    parts, bounds = _loaded(path, np.eye(3), generator, config or ObjectReading())
    placed = []
    for mesh, material in parts:
        vertices = (mesh.vertices * bounds.radius + bounds.centre).astype(np.float32)
        placed.append((TriangleMesh(vertices, mesh.faces, mesh.vertex_normals), material))
    return placed


def _loaded(
    path: Path, world_from_file: np.ndarray, generator: np.random.Generator, config: ObjectReading
) -> tuple[Parts, Bounds]:
    raw = _read(path, config.limits)
    try:
        parts, bounds = normalized(path.name, raw, world_from_file)
        return _made(path, parts, generator, config), bounds
    except BrokenObject:
        raise
    except (UserError, *_BAD_CONTENT) as error:
        raise _unreadable(path, error) from error


def _made(path: Path, parts: list[RawPart], generator: np.random.Generator, config: ObjectReading) -> Parts:
    """Placed raw parts as meshes, with their textures decoded."""
    parts = merged_by_material(parts)
    config.limits.check_faces(path.name, sum(len(part.faces) for part in parts))
    for part in parts:
        is_clear = part.material is None and part.color_alpha < _OPAQUE_VERTICES
        if is_clear or (part.material and lets_light_through(part.material, 255, part.color_alpha)):
            raise transparent(path.name)
    drawn = config.missing.draw(generator)
    if not any(part.colors is not None or (part.material and part.material.has_color) for part in parts):
        parts = _recolored(parts, drawn)
    textured = {id(part.material) for part in parts if part.material and part.material.needs_uv}
    maker = MaterialMaker(path.name, config.limits, len(textured))
    return [_finished(part, maker, drawn) for part in parts]


def _read(path: Path, limits: ReadingLimits) -> list[RawPart]:
    suffix = path.suffix.lower()
    try:
        match suffix:
            case ".glb" | ".gltf":
                return read_gltf(path, limits)
            case ".obj":
                return read_obj(path, limits)
            case ".ply":
                return read_ply(path, limits)
    except _BAD_CONTENT as error:
        raise _unreadable(path, error) from error
    except OSError as error:
        # every other object would seem to be broken too, and be left out for ever
        raise UserError(
            f"{path.name} cannot be read from where it lies",
            got=f"{type(error).__name__}: {error}",
            fix="see that its disk or network share answers and may be read, and run the same command again",
        ) from error
    raise BrokenObject("unreadable", f"{path.name} is of no known format", wanted=", ".join(OBJECT_SUFFIXES))


def _unreadable(path: Path, error: Exception) -> BrokenObject:
    return BrokenObject("unreadable", f"{path.name} is unreadable", got=f"{type(error).__name__}: {error}")


def _world_from_file(path: Path, up_axis: UpAxis) -> np.ndarray:
    match path.suffix.lower(), up_axis:
        case (".glb" | ".gltf", _) | (_, "y") | (".obj", "auto"):
            return _WORLD_FROM_Y_UP
        case _:
            return np.eye(3)


def _recolored(parts: list[RawPart], drawn: Material) -> list[RawPart]:
    """Parts of an object that has no colour anywhere, with the drawn albedo; materials that are shared stay shared."""
    albedo = tuple(float(value) for value in np.asarray(drawn.base_color))
    new: dict[int, RawMaterial] = {}
    for part in parts:
        if part.material is not None and id(part.material) not in new:
            new[id(part.material)] = replace(part.material, color=albedo)  # type: ignore[arg-type]
    return [part if part.material is None else replace(part, material=new[id(part.material)]) for part in parts]


def _finished(part: RawPart, maker: MaterialMaker, drawn: Material) -> tuple[TriangleMesh, Material]:
    """Mesh and material of a part; `drawn` fills in what is missing."""
    assert part.normals is not None
    mesh = TriangleMesh(
        np.ascontiguousarray(part.vertices, np.float32),
        np.ascontiguousarray(part.faces, np.int32),
        np.ascontiguousarray(part.normals, np.float32),
    )
    material = _base_material(part, maker, drawn)
    if part.colors is None:
        return mesh, material
    is_constant = bool((part.colors == part.colors[0]).all())
    if material.is_textured and not is_constant:
        # an image times vertex colours is neither; both go onto the vertices of a finer mesh
        return baked_with_tint(mesh, material, part.colors)
    tint = part.colors[0] if is_constant else part.colors
    color = np.ascontiguousarray(np.asarray(material.base_color, np.float32) * tint, np.float32)
    return mesh, Material(color, material.roughness, material.metallic, material.uv, normal_map=material.normal_map)


def _base_material(part: RawPart, maker: MaterialMaker, drawn: Material) -> Material:
    """The material before vertex colours."""
    white = (1.0, 1.0, 1.0)
    raw = part.material
    if raw is None:
        return Material(white if part.colors is not None else drawn.base_color, drawn.roughness, drawn.metallic)
    if raw.needs_uv and part.uv is not None:
        return maker.textured(raw, part.uv)
    return maker.constant(raw)
