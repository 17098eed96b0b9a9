"""The geometry benchmark, tiny: photographed, estimated, scored, resumable; and scores that know a wrong surface."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from illuminerf import geometry_benchmark
from illuminerf.evaluation.tables import geometry_ablation_table, geometry_table
from illuminerf.fields.meshing import EmptySurface
from illuminerf.presets import Preset, customised
from illuminerf.scene.images import read_png
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.scene.procedural import studio_light
from illuminerf.stages import render_object_capture, score_geometry
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.config import to_json
from illuminerf.workflow.errors import UserError
from tests.stages.conftest import TINY_GEOMETRY

SCORES = score_geometry.Config(spacing_percent=1.0, ray_size=48, num_sheet_views=1, device="cpu")


def tiny() -> Preset:
    optimiser = dataclasses.replace(TINY_GEOMETRY.optimiser, num_steps=60)
    return dataclasses.replace(
        customised("embedded", size=32, device="cpu"), geometry=dataclasses.replace(TINY_GEOMETRY, optimiser=optimiser)
    )


SETTINGS = geometry_benchmark.Settings(
    render_object_capture.Config(
        num_views=8, num_test_views=2, size=32, samples_per_pixel=4, places="all", max_light_height=16, device="cpu"
    ),
    tiny(),
    SCORES,
)


@pytest.fixture(scope="module")
def collection(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """objects/ball.glb, objects/broken.glb, studio.exr."""
    folder = tmp_path_factory.mktemp("collection")
    sphere_mesh(3).save_glb(folder / "objects" / "ball.glb")
    (folder / "objects" / "broken.glb").write_bytes(b"no model")
    studio_light(16).save(folder / "studio.exr")
    return folder


@pytest.fixture(scope="module")
def finished(collection: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("benchmark") / "run"
    chosen = geometry_benchmark.chosen_objects(collection / "objects", ())
    geometry_benchmark.run(chosen, [collection / "studio.exr"], SETTINGS, out)
    return out


def test_every_object_is_scored_and_broken_ones_are_left_out(finished: Path) -> None:
    result = read_json(finished / "scores.json")
    assert set(result["objects"]) == {"ball"} and set(result["left_out"]) == {"broken"} and not result["failed"]
    scores = result["objects"]["ball"]
    assert scores["light"] == "studio" and scores["mask_iou"] > 0.8 and scores["chamfer_percent"] < 4
    assert 0 < scores["normal_degrees"] < 30 and scores["psnr"] > 12 and scores["floater_share"] == 0
    assert scores["f_score_half_percent"] <= scores["f_score_1_percent"] <= 1
    assert len(scores["per_view"]["psnr"]) == 2 and scores["fit_seconds"] > 0
    assert result["mean"]["psnr"] == pytest.approx(scores["psnr"])
    assert geometry_table(result["objects"], result["mean"]).row_count == 2
    sheet = read_png(finished / "ball" / "scores" / "sheet.png")
    assert sheet.shape == (16 + 32, 5 * 32, 3)


def scored(finished: Path, mesh: TriangleMesh, folder: Path) -> dict[str, float]:
    """Scores with another mesh, in the unit ball, in place of the estimated one."""
    ball = finished / "ball"
    shutil.copytree(
        ball / "geometry", folder / "geometry", ignore=shutil.ignore_patterns("config.json", "inputs.json", "DONE")
    )
    mesh.save_glb(folder / "geometry" / "mesh.glb")
    inputs = (ball / "source", ball / "capture", folder / "geometry", ball / "test_views")
    return read_json(score_geometry.run(*inputs, SCORES, folder / "scores") / "scores.json")


def test_the_true_mesh_scores_no_error_and_a_wrong_one_does(finished: Path, tmp_path: Path) -> None:
    world = read_json(finished / "ball" / "capture" / "capture.json")
    scale, offset = world["scale"], np.array(world["offset"])
    truth = TriangleMesh.load_glb(finished / "ball" / "source" / "truth" / "mesh.glb")

    def placed(factor: float) -> TriangleMesh:
        vertices = ((truth.vertices * factor + offset) * scale).astype(np.float32)
        return TriangleMesh(vertices, truth.faces, truth.vertex_normals)

    right = scored(finished, placed(1.0), tmp_path / "right")
    assert right["normal_degrees"] < 0.2 and right["chamfer_percent"] < 0.02 and right["mask_iou"] == 1
    assert right["f_score_half_percent"] == 1 and 0.5 < right["face_normal_degrees"] < 10
    assert right["true_face_normal_degrees"] == pytest.approx(right["face_normal_degrees"], rel=0.02)
    wrong = scored(finished, placed(1.1), tmp_path / "wrong")
    assert max(found["true_mesh_normal_degrees"] for found in (right, wrong)) < 0.2
    # 0.1 of the radius is 2.9 percent of the box's diagonal
    assert wrong["chamfer_percent"] == pytest.approx(100 * 0.1 / (2 * 3**0.5), rel=0.05)
    assert wrong["normal_degrees"] > 2 and wrong["mask_iou"] < 0.9 and wrong["f_score_1_percent"] == 0


def test_a_second_run_loads_everything(finished: Path, collection: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("DONE")}
    scores = (finished / "scores.json").read_bytes()
    chosen = geometry_benchmark.chosen_objects(collection / "objects", ())
    geometry_benchmark.run(chosen, [collection / "studio.exr"], SETTINGS, finished)
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("DONE")} == before and len(before) == 5
    assert (finished / "scores.json").read_bytes() == scores


def test_a_surface_that_did_not_come_about_is_a_failure_of_that_object(
    collection: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(finished, tmp_path / "run", ignore=shutil.ignore_patterns("scores*"))
    scores = read_json(finished / "ball" / "scores" / "scores.json") | {"seconds": 1.0}

    def estimate(source: Path, capture: Path, settings: geometry_benchmark.Settings, out: Path) -> dict[str, float]:
        if settings.preset.geometry.radiance_field.has_proposal == (out.name == "no_proposal"):
            raise AssertionError("an ablation in another's folder")
        if out.name == "no_proposal":
            raise EmptySurface("the fitted surface is empty")
        changed = 1.0 if out.name == "sphere_start" else 0.0
        assert settings.preset.geometry.losses.starts_from_hull == (not changed)
        return scores | {"normal_degrees": scores["normal_degrees"] + changed}

    monkeypatch.setattr(geometry_benchmark, "score_estimate", estimate)
    chosen = geometry_benchmark.chosen_objects(collection / "objects", ["ball"])
    settings = dataclasses.replace(SETTINGS, ablations=("no_proposal", "sphere_start"))
    result = geometry_benchmark.run(chosen, [collection / "studio.exr"], settings, tmp_path / "run")
    assert set(result["objects"]) == {"ball"} and not result["failed"]
    empty, changed = result["ablations"]["no_proposal"], result["ablations"]["sphere_start"]
    assert set(empty["failed"]) == {"ball"} and empty["mean"] is None
    assert changed["mean"]["normal_degrees"] == pytest.approx(changed["of_full"]["normal_degrees"] + 1)
    assert geometry_ablation_table(result["ablations"]).row_count == 2

    def fails(*_: object) -> dict[str, float]:
        raise EmptySurface("the fitted surface is empty")

    monkeypatch.setattr(geometry_benchmark, "score_estimate", fails)
    with pytest.raises(UserError, match="no object could be measured"):
        geometry_benchmark.run(chosen, [collection / "studio.exr"], SETTINGS, tmp_path / "run")


def test_every_ablation_changes_one_thing() -> None:
    full = to_json(SETTINGS.preset.geometry)
    changed = {name: to_json(change(SETTINGS.preset.geometry)) for name, change in geometry_benchmark.ABLATIONS.items()}
    differences = [_differences(full, config) for config in changed.values()]
    assert all(len(found) == 1 for found in differences) and len(set(map(tuple, differences))) == len(changed)


def _differences(first: Any, second: Any, name: str = "") -> list[str]:
    if isinstance(first, dict):
        return [found for key in first for found in _differences(first[key], second[key], f"{name}.{key}")]
    return [] if first == second else [name]


def test_objects_are_chosen_by_name_and_lights_by_the_objects_name(collection: Path) -> None:
    chosen = geometry_benchmark.chosen_objects(collection / "objects", ["ball"])
    assert [item.id for item in chosen] == ["ball"]
    with pytest.raises(UserError, match="no such models; got bowl"):
        geometry_benchmark.chosen_objects(collection / "objects", ["bowl", "ball"])
    lights = [Path(f"{number}.exr") for number in range(3)]
    assert {geometry_benchmark.light_of(f"object {i}", lights) for i in range(20)} == set(lights)
    assert geometry_benchmark.light_files(collection) == [collection / "studio.exr"]
    with pytest.raises(UserError, match="no light"):
        geometry_benchmark.light_files(collection / "objects")


def test_ablations_are_chosen_by_name() -> None:
    assert geometry_benchmark.chosen_ablations(()) == ()
    assert geometry_benchmark.chosen_ablations(["sphere_start"]) == ("sphere_start",)
    assert geometry_benchmark.chosen_ablations(["all"]) == tuple(geometry_benchmark.ABLATIONS)
    with pytest.raises(UserError, match="no such ablations; got cube_start"):
        geometry_benchmark.chosen_ablations(["cube_start", "sphere_start"])
