"""Geometry + the capture's truth -> scores: normals, distances, masks and views against what was photographed.

scores.json    what `docs/benchmarks.md` explains, one number each, and per view
sheet.png      some unseen views: photograph, rendering, true normals, estimated normals, error of the normals
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from illuminerf.cues.mesh_views import MeshScene, seen_surfels
from illuminerf.data.capture import Capture, image_path, load_capture
from illuminerf.evaluation.benchmark_rule import view_pair
from illuminerf.evaluation.geometry_scores import (
    angles_degrees,
    area_surfels,
    box_diagonal,
    floater_share,
    intersection_over_union,
    surface_distances,
)
from illuminerf.evaluation.geometry_sheet import SurfaceView, contact_sheet, covered_by_both
from illuminerf.evaluation.metrics import psnr
from illuminerf.fields.storage import load_field
from illuminerf.fields.surface import SurfaceField
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import read_exr, read_png, write_png
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.views import spread_evenly
from illuminerf.workflow.artefact import open_artefact, read_metrics
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.device import numpy_generator, resolve_device
from illuminerf.workflow.errors import UserError

_AREA_POINTS = 200_000
_CHUNK = 1 << 16


@dataclass(frozen=True)
class Config:
    """What is measured how finely."""

    spacing_percent: float = 0.25
    """Between the points that distances are taken at, in percent of the object's size, which is the diagonal of its
    bounding box."""
    ray_size: int = 400
    """Rays along each side of every photograph that find what of a surface is seen."""
    floater_percent: float = 2.0
    """Connected parts of the mesh that come nowhere closer to the truth, in percent of its size, are floaters."""
    num_sheet_views: int = 4
    """Unseen views on the contact sheet."""
    seed: int = 0
    """Of points on the truth's hidden parts."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if not 0 < self.spacing_percent <= 5 or not 0 < self.floater_percent <= 100:
            raise UserError("spacing and floaters are out of range", got=str(self), wanted="up to 5 and 100 percent")
        if self.ray_size < 16 or self.num_sheet_views < 1:
            raise UserError("there is too little to see", wanted="16 rays and 1 view, or more")


def run(source: Path, capture_path: Path, geometry: Path, novel_views: Path, config: Config, out: Path) -> Path:
    """Score the geometry that was estimated from a made-up capture.

    Args:
        source: an ObjectCapture artefact.
        capture_path: the Capture artefact imported from it.
        geometry: the Geometry artefact estimated from that.
        novel_views: the geometry's own appearance rendered in all unseen views of `source`.
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: inputs do not belong together, or `out` was made with other settings.
    """
    inputs: dict[str, Path | str] = {
        "source": source, "capture": capture_path, "geometry": geometry, "novel_views": novel_views
    }  # fmt: skip
    with open_artefact(out, "score_geometry", config, inputs) as artefact:
        if artefact.is_done:
            return out
        capture, truth = load_capture(capture_path), TriangleMesh.load_glb(source / "truth" / "mesh.glb")
        mesh = _in_callers_world(TriangleMesh.load_glb(geometry / "mesh.glb"), capture)
        size = box_diagonal(truth)
        photographed = Cameras.from_dict(read_json(source / "cameras.json"))
        views = _views(mesh, source, novel_views, config.device)
        scores = _distances(mesh, truth, photographed, size, config)
        reach = config.floater_percent / 100 * size
        whole_truth = area_surfels(truth, _AREA_POINTS, numpy_generator(config.seed, "truth"))
        scores["floater_share"] = floater_share(mesh, whole_truth, reach)
        scores |= _view_scores(views)
        others = {
            "gradient": (replace(mesh, vertex_normals=_gradients(geometry, config.device)), True),
            "face": (mesh, False),
            "true_mesh": (truth, True),
            "true_face": (truth, False),
        }
        for name, (surface, is_smooth) in others.items():
            errors = _normal_errors(surface, is_smooth, source, views, config.device)
            scores[f"{name}_normal_degrees"] = float(errors.mean())
        scores["num_faces"] = len(mesh.faces)
        scores["fit_seconds"] = read_metrics(geometry).get("fit_seconds", read_metrics(geometry)["seconds"])
        write_json(out / "scores.json", scores)
        chosen = spread_evenly(len(views), config.num_sheet_views)
        write_png(out / "sheet.png", contact_sheet([views[view] for view in chosen]))
        artefact.finish({name: scores[name] for name in ("normal_degrees", "chamfer_percent", "psnr")})
    return out


def _in_callers_world(mesh: TriangleMesh, capture: Capture) -> TriangleMesh:
    vertices = mesh.vertices.astype(np.float64) / capture.scale - capture.offset
    return TriangleMesh(vertices.astype(np.float32), mesh.faces, mesh.vertex_normals)


def _views(mesh: TriangleMesh, source: Path, novel_views: Path, device: str) -> list[SurfaceView]:
    """All unseen views, of the estimate as specular cues see it."""
    cameras = Cameras.from_dict(read_json(source / "test" / "cameras.json"))
    scene = MeshScene(mesh, device=device)
    views = []
    for view in range(len(cameras)):
        true = read_exr(source / "test" / "normals" / f"{view:03d}.exr")
        normals, coverage = scene.normals(cameras, view)
        photograph, rendered = (read_png(image_path(folder, view)) for folder in (source / "test", novel_views))
        if photograph.shape != rendered.shape:
            raise UserError(
                "a rendered view has another size than the true one",
                got=str(rendered.shape[:2]),
                wanted=str(photograph.shape[:2]),
            )
        true_normals = np.stack([true[axis] for axis in "XYZ"], -1)
        views.append(SurfaceView(photograph, rendered, true_normals, true["A"], normals, coverage))
    return views


def _distances(
    mesh: TriangleMesh, truth: TriangleMesh, photographed: Cameras, size: float, config: Config
) -> dict[str, Any]:
    spacing = config.spacing_percent / 100 * size
    estimated, true = (seen_surfels(m, photographed, spacing, config.ray_size, config.device)[0] for m in (mesh, truth))
    found = surface_distances(estimated, true, size)
    return {
        "chamfer_percent": found.chamfer,
        "accuracy_percent": found.accuracy,
        "completeness_percent": found.completeness,
        "f_score_half_percent": found.f_score(0.5),
        "f_score_1_percent": found.f_score(1.0),
    }


def _view_scores(views: list[SurfaceView]) -> dict[str, Any]:
    """Scores of all unseen views together, and of each."""
    per_view = [_scores_of([view]) for view in views]
    names = list(per_view[0])
    return _scores_of(views) | {"per_view": {name: [scores[name] for scores in per_view] for name in names}}


def _scores_of(views: list[SurfaceView]) -> dict[str, float]:
    errors = np.concatenate([angles_degrees(v.true_normals, v.normals)[covered_by_both(v)] for v in views])
    pairs = [view_pair(view.rendered, view.photograph) for view in views]
    true = np.stack([view.true_coverage > 0.5 for view in views])
    return {
        "normal_degrees": float(errors.mean()) if len(errors) else 90.0,
        "normal_median_degrees": float(np.median(errors)) if len(errors) else 90.0,
        "mask_iou": intersection_over_union(np.stack([view.coverage > 0.5 for view in views]), true),
        "field_mask_iou": intersection_over_union(np.stack([v.rendered[..., 3] > 0.5 for v in views]), true),
        "psnr": float(np.mean([psnr(pair.prediction, pair.truth) for pair in pairs])),
    }


def _normal_errors(
    mesh: TriangleMesh, is_smooth: bool, source: Path, views: list[SurfaceView], device: str
) -> np.ndarray:
    """Errors, in degrees, of other normals, or of another surface's, over the same pixels."""
    cameras = Cameras.from_dict(read_json(source / "test" / "cameras.json"))
    scene = MeshScene(mesh, is_smooth, device)
    errors = [
        angles_degrees(view.true_normals, scene.normals(cameras, number)[0])[covered_by_both(view)]
        for number, view in enumerate(views)
    ]
    return np.concatenate(errors) if any(map(len, errors)) else np.array([90.0])


@torch.no_grad()
def _gradients(geometry: Path, device: str) -> np.ndarray:
    """Unit gradients of the signed distance at the mesh's vertices."""
    mesh = TriangleMesh.load_glb(geometry / "mesh.glb")
    surface: SurfaceField = load_field(geometry, resolve_device(device)).field.surface
    positions = torch.from_numpy(mesh.vertices).to(next(surface.parameters()).device)
    gradients = torch.cat([surface(chunk).gradient for chunk in positions.split(_CHUNK)])
    return functional.normalize(gradients, dim=-1, eps=1e-6).cpu().numpy()
