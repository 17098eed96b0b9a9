"""The paper's study of Stanford-ORB's illumination (supplement): what scores say where no light is right.

The light of a test view was measured with a probe that was moved for every view, so the maps of one capture differ.
The scanned object, rendered under one map for all views ("fixed") and under each view's own ("per_image"), stands in
for the photographs, and methods are scored against both.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro

from illuminerf.data.orb_lights import typical_view, write_light
from illuminerf.data.stanford_orb import OrbView, cameras_of, check_files, find_captures, load_photograph, own_views
from illuminerf.evaluation.orb_tables import study_table
from illuminerf.scene.images import read_rgb_exr
from illuminerf.stages import render_reference_views
from illuminerf.stages.score_orb_predictions import (
    Cell,
    Image,
    available_lpips,
    relighting_cells,
    score_orb_predictions,
    score_views,
    size_of,
    summary,
)
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.named_folders import named_folders
from illuminerf.workflow.progress import say, show_table

REFERENCES = ("fixed", "per_image")
PHOTOGRAPHS = "the photographs"


def illumination_study_command(
    root: tyro.conf.Positional[Path],
    out: Path,
    objects: tuple[str, ...] = (),
    renderings: tuple[str, ...] = (),
    meshes: Path | None = None,
    size: int | None = None,
    lpips: bool = False,
    samples_per_pixel: int = 128,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """The paper's study of Stanford-ORB's illumination: the scanned objects, rendered under one light for all views and
    under the light of each view, stand in for the photographs.

    Args:
        root: Unpacked benchmark, with ground_truth.
        out: Folder of the references; run the same command again to go on after an interruption.
        objects: Objects or captures; by default all.
        renderings: NAME=FOLDER of a method's renderings, <capture>/<target capture>/0061.png.
        meshes: Folder with <capture>/<one .obj, .glb, .gltf or .ply>, in the capture's world, instead of the
            benchmark's ground_truth/<capture>/mesh_blender.
        size: Render and score at this image size in pixels, below the benchmark's 512.
        lpips: Also compute LPIPS, where the optional package is installed.
        samples_per_pixel: Paths per pixel of the references.
        seed: Of the paths.
        device: auto, cpu or cuda.
    """
    captures = find_captures(root, objects)
    config = render_reference_views.Config(samples_per_pixel=samples_per_pixel, device=device, seed=seed)
    means = study(root, captures, named_folders(renderings), meshes, config, out, size, lpips)
    show_table(study_table(means))
    say(f"done: {out / 'study.json'}")


def study(
    root: Path,
    captures: Sequence[str],
    methods: dict[str, Path],
    meshes: Path | None,
    config: render_reference_views.Config,
    out: Path,
    size: int | None = None,
    with_lpips: bool = False,
) -> dict[str, dict[str, dict[str, float]]]:
    """Render the references of every capture that is a target, and score `methods` and the photographs against both.

    Returns:
        By method, and under PHOTOGRAPHS, the means over captures against references under the "fixed" and the
        "per_image" light. All scores are in study.json.
    """
    cells = relighting_cells(root, captures)
    pixels = size_of(root, cells, size)
    targets = sorted({cell.target for cell in cells})
    own = {target: tuple(own_views(root, target)) for target in targets}
    check_files(root, [view for views in own.values() for view in views])
    folders = {
        target: (meshes or root / "ground_truth") / target / ("" if meshes else "mesh_blender") for target in own
    }
    for folder in folders.values():
        render_reference_views.object_file(folder)
    lpips = available_lpips(with_lpips)
    scores: dict[str, dict[str, Any]] = {name: {} for name in (*methods, PHOTOGRAPHS)}
    for illumination in REFERENCES:
        references = {
            target: _references(root, own[target], folders[target], illumination, config, pixels, out / target)
            for target in targets
        }
        truth = _image_of(references, own)
        for name, folder in methods.items():
            scores[name][illumination] = score_orb_predictions(root, folder, captures, size, with_lpips, truth)
        pictures = {
            Cell(target, target, views): score_views(root, views, _photograph(root, pixels), pixels, truth, lpips)
            for target, views in own.items()
        }
        scores[PHOTOGRAPHS][illumination] = summary(pictures)
    write_json(out / "study.json", scores)
    return {name: {key: found["mean"] for key, found in by_light.items()} for name, by_light in scores.items()}


def _references(
    root: Path,
    views: tuple[OrbView, ...],
    object_folder: Path,
    illumination: str,
    config: render_reference_views.Config,
    size: int,
    out: Path,
) -> Path:
    """References of a target's test views in its own world."""
    say(f"references: {views[0].capture}, light {illumination}")
    cameras = out / "cameras.json"
    write_json(cameras, cameras_of(views, size).to_dict())
    chosen = views
    if illumination == "fixed":
        chosen = (views[typical_view(root, views[0].capture, views)],)
    lights = [out / "lights" / f"{view.name}.exr" for view in chosen]
    for view, path in zip(chosen, lights, strict=True):
        write_light(root, view, config.max_light_height, path)
    return render_reference_views.run(object_folder, cameras, lights, config, out / illumination)


def _image_of(references: dict[str, Path], own: dict[str, tuple[OrbView, ...]]) -> Image:
    places = {(target, view.name): index for target, views in own.items() for index, view in enumerate(views)}

    def image(view: OrbView) -> Any:
        place = places[view.capture, view.name]
        return read_rgb_exr(render_reference_views.reference_path(references[view.capture], place))

    return image


def _photograph(root: Path, size: int) -> Image:
    return lambda view: load_photograph(root, view, size)
