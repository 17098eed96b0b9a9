"""How good estimated geometry is: models photographed by our own path tracer, so that the truth is known.

    model + light --path tracer--> photographs, unseen views, true normals and mesh    once per object
    photographs --import, UniSDF--> geometry --> unseen views, scores                   once per object and ablation

An ablation is the same fit with one part of the method changed.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from illuminerf import pipeline
from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.light_library import light_paths
from illuminerf.data.object_collection import CollectionObject, list_objects
from illuminerf.evaluation.tables import geometry_ablation_table, geometry_table
from illuminerf.fields.meshing import EmptySurface
from illuminerf.presets import Preset, customised
from illuminerf.stages import (
    estimate_geometry,
    import_capture,
    render_novel_views,
    render_object_capture,
    score_geometry,
)
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.device import derived_seed
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, show_table

_SYMMETRIC = (1e-3, 1e-3, 1e-3)

Ablation = Callable[[estimate_geometry.Config], estimate_geometry.Config]


def _with_losses(**values: Any) -> Ablation:
    return lambda config: replace(config, losses=replace(config.losses, **values))


def _with_field(**values: Any) -> Ablation:
    return lambda config: replace(config, radiance_field=replace(config.radiance_field, **values))


def _one_radiance_field(config: estimate_geometry.Config) -> estimate_geometry.Config:
    return _with_field(appearance=replace(config.radiance_field.appearance, radiance="camera"))(config)


def _shared_normal_features(config: estimate_geometry.Config) -> estimate_geometry.Config:
    return _with_field(surface=replace(config.radiance_field.surface, has_normal_grid=False))(config)


ABLATIONS: dict[str, Ablation] = {
    "one_radiance_field": _one_radiance_field,
    "no_coarse_to_fine": _with_losses(coarse_to_fine_share=0.0),
    "no_proposal": _with_field(has_proposal=False),
    "symmetric_normal_loss": _with_losses(predicted_normals=_SYMMETRIC),
    "shared_normal_features": _shared_normal_features,
    "no_normal_smoothness": _with_losses(normal_smoothness=0.0),
    "predicted_radiance_normals": _with_field(radiance_normals="predicted"),
    "sphere_start": _with_losses(starts_from_hull=False),
    "black_background": _with_losses(random_background=False),
    "even_rays": _with_losses(guided_share=0.0),
    "zero_level": lambda config: replace(config, outlines_set_level=False),
    "predicted_mesh_normals": lambda config: replace(config, mesh_normals="predicted"),
}
"""What each changes of a geometry's settings: one thing."""


@dataclass(frozen=True)
class Settings:
    """What happens to every object."""

    capture: render_object_capture.Config
    preset: Preset
    """Its capture, geometry and test_views."""
    scores: score_geometry.Config
    ablations: tuple[str, ...] = ()
    """Names of those that every object is also fitted with."""


def geometry_command(
    collection: tyro.conf.Positional[Path],
    lights: tyro.conf.Positional[Path],
    out: Path,
    objects: tuple[str, ...] = (),
    num_views: int = 100,
    size: int = 400,
    test_views: int = 20,
    samples_per_pixel: int = 64,
    all_around: bool = False,
    preset: str = "embedded",
    steps: int | None = None,
    ablations: tuple[str, ...] = (),
    json: Path | None = None,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """Geometry against the truth: photograph models with the path tracer, estimate their geometry, and score it.

    Args:
        collection: Folder of .glb, .gltf, .obj and .ply models.
        lights: An .exr or .hdr map, or a folder of them: each object gets the one that its name draws.
        out: Folder of the run; run the same command again to go on after an interruption.
        objects: Only these models, by file name without suffix; all where it is left out.
        num_views: Photographs of each object.
        size: Their width and height in pixels, and the size that the geometry is estimated at.
        test_views: Unseen views that normals, masks and colours are compared in.
        samples_per_pixel: Paths per pixel.
        all_around: Photograph from below too, not from the upper half of the sphere only.
        preset: Whose geometry settings are measured: see `illuminerf presets`.
        steps: Steps of the fit, where not the preset's.
        ablations: Also fit every object with these parts of the method changed, one at a time: names as in
            docs/benchmarks.md, or all.
        json: Also write the scores here.
        seed: Of every random stream.
        device: auto, cpu or cuda.
    """
    chosen = chosen_objects(collection, objects)
    settings = Settings(
        render_object_capture.Config(
            num_views=num_views,
            num_test_views=test_views,
            size=size,
            samples_per_pixel=samples_per_pixel,
            places="all" if all_around else "upper",
            seed=seed,
            device=device,
        ),
        with_steps(customised(preset, size=size, seed=seed, device=device), steps),
        score_geometry.Config(seed=seed, device=device),
        chosen_ablations(ablations),
    )
    result = run(chosen, light_files(lights), settings, out)
    if json is not None:
        write_json(json, result)
    show_table(geometry_table(result["objects"], result["mean"]))
    if ablations:
        show_table(geometry_ablation_table(result["ablations"]))
    say(f"done: {out / 'scores.json'}, {out}/<object>/scores/sheet.png")


def chosen_objects(collection: Path, names: Sequence[str]) -> list[CollectionObject]:
    """The models of a collection, or those with the given names.

    Raises:
        UserError: there is no such model.
    """
    found = list_objects(collection)
    unknown = set(names) - {item.id for item in found} - {item.path.stem for item in found}
    if unknown:
        shown = ", ".join(item.id for item in found[:8])
        raise UserError(
            "no such models",
            got=", ".join(sorted(unknown)),
            wanted=f"some of {shown}{', ...' if len(found) > 8 else ''}",
        )
    return [item for item in found if not names or {item.id, item.path.stem} & set(names)]


def chosen_ablations(names: Sequence[str]) -> tuple[str, ...]:
    """The ablations of these names; "all" stands for every one.

    Raises:
        UserError: there is no such ablation.
    """
    unknown = set(names) - {*ABLATIONS, "all"}
    if unknown:
        raise UserError("no such ablations", got=", ".join(sorted(unknown)), wanted=f"all, {', '.join(ABLATIONS)}")
    return tuple(name for name in ABLATIONS if {name, "all"} & set(names))


def light_files(lights: Path) -> list[Path]:
    """The map, or the maps of a folder.

    Raises:
        UserError: there is none.
    """
    found = light_paths(lights) if lights.is_dir() else [lights]
    if not found or not found[0].is_file():
        raise UserError("there is no light", got=str(lights), wanted="an .exr or .hdr map, or a folder of them")
    return found


def light_of(name: str, lights: Sequence[Path]) -> Path:
    """The light of an object: drawn by its name, so that it does not depend on which other objects are chosen."""
    return lights[derived_seed(0, "light", name) % len(lights)]


def with_steps(preset: Preset, steps: int | None) -> Preset:
    """The preset with another number of steps of the geometry fit."""
    if steps is None:
        return preset
    optimiser = replace(preset.geometry.optimiser, num_steps=steps)
    return replace(preset, geometry=replace(preset.geometry, optimiser=optimiser))


def run(objects: Sequence[CollectionObject], lights: Sequence[Path], settings: Settings, out: Path) -> dict[str, Any]:
    """Measure every object; what scores.json holds is returned: "objects" by name with their scores, "mean" over them,
    "failed" and "left_out" by name with the reason; and "ablations" by name, each with "objects", "failed", "mean" and
    "of_full", the mean of the unchanged method over the same objects.

    Raises:
        UserError: bad input, no object is left, or `out` was made with other settings.
    """
    full, changed = Fits(), {name: Fits() for name in settings.ablations}
    left_out: dict[str, str] = {}
    for item in objects:
        say(f"object: {item.id}")
        light, folder = light_of(item.id, lights), out / item.id
        try:
            source, capture = photograph(item, light, settings, folder)
        except BrokenObject as error:
            left_out[item.id] = str(error)
            say(f"left out: {error}")
            continue
        full.add(item.id, light, source, capture, settings, folder)
        for name, fits in changed.items():
            say(f"ablation: {name}")
            fits.add(item.id, light, source, capture, ablated(settings, name), folder / "ablations" / name)
    if not full.objects:
        raise UserError("no object could be measured", got="; ".join([*left_out.values(), *full.failed.values()]))
    result = {**asdict(full), "mean": mean_scores(list(full.objects.values())), "left_out": left_out}
    result["ablations"] = {name: asdict(fits) | fits.compared_with(full) for name, fits in changed.items()}
    write_json(out / "scores.json", result)
    return result


@dataclass
class Fits:
    """Scores by object, and reasons where a fit ended without a surface, which is a result too."""

    objects: dict[str, dict[str, Any]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, light: Path, source: Path, capture: Path, settings: Settings, out: Path) -> None:
        """Fit one more object."""
        try:
            self.objects[name] = {"light": light.stem, **score_estimate(source, capture, settings, out)}
        except EmptySurface as error:
            self.failed[name] = str(error)
            say(f"failed: {error}")

    def compared_with(self, full: "Fits") -> dict[str, dict[str, float] | None]:
        """Means over the objects that both reconstructed; None where there are none."""
        both = [name for name in self.objects if name in full.objects]
        of_each = {"mean": self, "of_full": full}
        return {key: mean_scores([of.objects[name] for name in both]) if both else None for key, of in of_each.items()}


def ablated(settings: Settings, name: str) -> Settings:
    """The settings with one part of the method changed."""
    preset = settings.preset
    return replace(settings, preset=replace(preset, geometry=ABLATIONS[name](preset.geometry)))


def photograph(item: CollectionObject, light: Path, settings: Settings, out: Path) -> tuple[Path, Path]:
    """Photograph one object: what was made up, and the capture that is imported from it."""
    source = render_object_capture.run(item.path, light, settings.capture, out / "source")
    return source, import_capture.run(source, settings.preset.capture, out / "capture")


def score_estimate(source: Path, capture: Path, settings: Settings, out: Path) -> dict[str, Any]:
    """Estimate the geometry of a made-up capture and score it in `out`; its seconds come with the scores."""
    preset = settings.preset
    geometry = estimate_geometry.run(capture, preset.geometry, out / "geometry")
    cameras = pipeline.in_unit_ball(source / "test" / "cameras.json", capture, out / "test_cameras.json")
    views = render_novel_views.run(geometry, cameras, preset.test_views, out / "test_views")
    scored = score_geometry.run(source, capture, geometry, views, settings.scores, out / "scores")
    return {**read_json(scored / "scores.json"), "seconds": read_metrics(geometry)["seconds"]}


def mean_scores(scores: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Mean of every number over objects."""
    names = [name for name, value in scores[0].items() if isinstance(value, int | float)]
    return {name: float(np.mean([of_object[name] for of_object in scores])) for name in names}
