"""All views of one object, as training samples: the unit of work of `render_training_pairs`.

What an item looks like depends on the settings, the seed, the item's name, the collection and the lights that are
drawn from, never on who makes it or when.
"""

import functools
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from illuminerf.cues.blender_renderer import BlenderFailed, BlenderItemRenderer, worker_command
from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.dents import DentVariation, dented, drawn_tilts
from illuminerf.cues.item_renderer import ItemRenderer, MitsubaItemRenderer
from illuminerf.cues.materials import Parts
from illuminerf.cues.mitsuba_variant import choose_variant, load_mitsuba
from illuminerf.cues.object_files import ObjectReading, load_object
from illuminerf.cues.renderer import CueSampling
from illuminerf.cues.shading import concatenated
from illuminerf.cues.training_cameras import CameraSphere, draw_camera
from illuminerf.cues.training_lights import LightVariation, draw_light
from illuminerf.cues.variations import MaterialVariation, varied
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.relighting_pairs import encode_item
from illuminerf.workflow.config import to_json
from illuminerf.workflow.device import derived_seed, numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.shards import LeftOut

_OBJECTS_IN_MEMORY = 2  # textures can take half a GB each


@dataclass(frozen=True)
class ViewSettings:
    """What is rendered of each object, and how well."""

    num_views: int = 4
    """Cameras per object (paper: 4)."""
    num_lights: int = 4
    """Lights per view (paper's main text: 4; its supplement: 2)."""
    size: int = 128
    """Height and width in pixels (paper: 512)."""
    samples_per_pixel: int = 64
    """Paths per pixel of the targets. Deviation: 512 in the paper; the noise of 64 lies some 38 dB below white."""
    cue_sampling: CueSampling = field(default_factory=CueSampling)
    """Paths and bounces of the cues."""
    cameras: CameraSphere = field(default_factory=CameraSphere)
    """Where cameras stand."""
    lights: LightVariation = field(default_factory=LightVariation)
    """How maps become lights."""
    materials: MaterialVariation = field(default_factory=MaterialVariation)
    """How objects are varied."""
    dents: DentVariation = field(default_factory=DentVariation)
    """How wrong the geometry of the cues is."""
    light_height: int = 256
    """Rows that all maps are brought to."""
    reading: ObjectReading = field(default_factory=ObjectReading)
    """How object files are read, and what those without materials are made of."""
    bakes_textures: bool = True
    """Move textures onto vertices, which saves compiling kernels; turn off above 128 pixels."""
    renderer: Literal["mitsuba", "blender"] = "mitsuba"
    """Path tracer; blender is an extra (docs/renderers.md)."""
    blender: str = ""
    """A `blender` program, or a Python that has bpy; "" looks for bpy here, then for `blender` on the PATH."""
    split: str = "train"
    """Written into each item's metadata."""
    seed: int = 0
    """Seed of every random choice, joined with the item's name."""

    def __post_init__(self) -> None:
        if min(self.num_views, self.size, self.samples_per_pixel) < 1 or self.num_lights < 2:
            raise UserError("training pairs need at least one view, one sample and two lights")
        if self.light_height < 8:
            raise UserError("light_height is too small", got=str(self.light_height), wanted="8 or more")

    @staticmethod
    def paper() -> "ViewSettings":
        """The paper's numbers (supplement, "Training Data Processing"); what it leaves open is as by default."""
        return ViewSettings(
            size=512,
            samples_per_pixel=512,
            cue_sampling=CueSampling(samples_per_pixel=512),
            cameras=CameraSphere.paper(),
            materials=MaterialVariation.none(),
            dents=DentVariation(0.0),
            light_height=512,
            bakes_textures=False,
        )

    def check_renderer(self) -> str:
        """What renders here; all machines of a run must say the same, since noise differs between them.

        Raises:
            UserError: the path tracer is not installed.
        """
        if self.renderer == "blender":
            worker_command(self.blender, Path())
            return "blender"
        load_mitsuba(self.cue_sampling.device)
        return choose_variant(self.cue_sampling.device)

    def item_renderer(self) -> ItemRenderer:
        """The path tracer."""
        if self.renderer == "blender":
            return BlenderItemRenderer(
                self.samples_per_pixel, self.cue_sampling, self.blender, bakes_properties=self.bakes_textures
            )
        return MitsubaItemRenderer(self.samples_per_pixel, self.cue_sampling, self.bakes_textures)


@dataclass(frozen=True)
class ObjectFile:
    """One object of a collection."""

    id: str
    """Unique in the collection; without dots and slashes, since it becomes part of file names."""
    path: str
    """Its model file."""
    licence: str = ""
    """As its collection states it."""


def item_key(object_id: str, view: int) -> str:
    """Name of one item."""
    return f"{object_id}_{view}"


def render_views(
    objects: Sequence[ObjectFile],
    index: int,
    lights: Sequence[EnvironmentMap],
    settings: ViewSettings,
    views: list[int],
) -> Iterator[tuple[int, dict[str, bytes] | LeftOut]]:
    """Render some views of one object of a collection.

    Args:
        objects: the whole collection, from which textures and neighbours are drawn.
        index: which object.
        lights: the maps to draw from, of one resolution.
        settings: what is rendered.
        views: which of its views.

    Yields:
        (view, files of a shard's sample, or why the object or view is left out).
    """
    item = objects[index]
    try:
        parts = _loaded(item, settings.seed, settings.reading)
    except BrokenObject as error:
        yield from ((view, LeftOut(error.reason, str(error))) for view in views)
        return
    for view in views:
        try:
            yield view, _rendered(parts, objects, index, lights, settings, view)
        except (BlenderFailed, RuntimeError, ValueError, ArithmeticError) as error:
            # what a renderer says of an odd mesh; errors of disks and settings are other UserErrors and go on up
            yield view, LeftOut("not rendered", f"{type(error).__name__}: {error}".splitlines()[0])


@functools.lru_cache(maxsize=_OBJECTS_IN_MEMORY)
def _loaded(item: ObjectFile, seed: int, reading: ObjectReading) -> Parts:
    return load_object(Path(item.path), numpy_generator(seed, "object", item.id), reading)


def _rendered(
    parts: Parts,
    objects: Sequence[ObjectFile],
    index: int,
    lights: Sequence[EnvironmentMap],
    settings: ViewSettings,
    view: int,
) -> dict[str, bytes] | LeftOut:
    item, key = objects[index], item_key(objects[index].id, view)
    generator = numpy_generator(settings.seed, "item", key)
    of_cameras, of_lights, of_materials = generator.spawn(3)
    drawn = {item.id: item}

    def draw_other(generator: np.random.Generator) -> tuple[str, Parts] | None:
        other = objects[int(generator.integers(len(objects)))]
        if other.id == item.id:
            return None
        try:
            found = _loaded(other, settings.seed, settings.reading)
        except BrokenObject:
            return None
        drawn[other.id] = other
        return other.id, found

    varied_parts, variations, donors = varied(parts, settings.materials, of_materials, draw_other)
    used = [drawn[name] for name in sorted({item.id, *donors})]
    vertices = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh, _ in varied_parts])
    camera = draw_camera(settings.cameras, settings.size, vertices, of_cameras)
    chosen = of_lights.choice(len(lights), settings.num_lights, replace=False)
    draws = [draw_light(lights[int(i)], of_lights, settings.lights) for i in chosen]
    seed = derived_seed(settings.seed, "render", key)
    of_dents = numpy_generator(settings.seed, "dents", key)
    tilts = drawn_tilts(settings.dents, of_dents)
    cue_mesh = None
    if tilts:
        whole = concatenated([mesh for mesh, _ in varied_parts])
        cue_mesh = dented(whole, settings.dents.sizes, tilts, of_dents)
    rendered = settings.item_renderer().render(varied_parts, camera, [light for light, _ in draws], seed, cue_mesh)
    if not (np.isfinite(rendered.targets).all() and np.isfinite(rendered.cues).all()):
        return LeftOut("not finite", "the rendering holds NaN or infinite radiance")
    if not (rendered.alpha > 0.5).any():
        return LeftOut("not seen", "no pixel shows the object")
    metadata: dict[str, Any] = {
        "object": item.id,
        "object_sha256": _sha256(item.path),
        "view": view,
        "split": settings.split,
        "variations": variations,
        "dent_tilts_degrees": tilts,
        "licences": {other.id: other.licence for other in used if other.licence},
        "lights": [to_json(draw) for _, draw in draws],
        "camera": camera.to_dict(),
        "coverage": float(rendered.alpha.mean()),
    }
    arrays = {name: getattr(rendered, name) for name in rendered.__dataclass_fields__}
    return encode_item(**arrays, metadata=metadata)


@functools.lru_cache(maxsize=_OBJECTS_IN_MEMORY)
def _sha256(path: str) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
