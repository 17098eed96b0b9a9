"""The Stanford-ORB benchmark and the study of its illumination on a data set of our own renderer."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from illuminerf import orb_illumination_study, stanford_orb
from illuminerf.cli import main
from illuminerf.data.stanford_orb import own_views
from illuminerf.evaluation.orb_tables import capture_table, published_orb_table, study_table
from illuminerf.evaluation.published import ILLUMINATION_STUDY, STANFORD_ORB
from illuminerf.presets import Preset
from illuminerf.scene.images import read_png
from illuminerf.stages import render_reference_views, render_synthetic_orb
from illuminerf.stages.score_orb_predictions import relighting_cells
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError
from tests.data.written_orb import NAMES, write_orb
from tests.evaluation.test_tables import printed
from tests.stages.test_score_orb_predictions import predict
from tests.test_pipeline import tiny

DATA = render_synthetic_orb.Config(
    objects=("cup",), size=32, num_views=5, num_test_views=2, samples_per_pixel=32, mesh_resolution=40, light_height=24,
    device="cpu",
)  # fmt: skip
REFERENCES = render_reference_views.Config(samples_per_pixel=32, device="cpu")
CUPS = ["cup_scene001", "cup_scene002"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_synthetic_orb.run(DATA, tmp_path_factory.mktemp("orb") / "data")


@pytest.fixture(scope="module")
def studied(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:  # type: ignore[type-arg]
    out = tmp_path_factory.mktemp("study")
    return out, orb_illumination_study.study(data, CUPS, {}, None, REFERENCES, out)


def test_references_are_the_photographs_where_lights_are_right(studied: tuple[Path, dict]) -> None:  # type: ignore[type-arg]
    """Mesh, material, axes, poses and lights all have to fit: a wrong turn of the light costs 8 dB."""
    means = studied[1][orb_illumination_study.PHOTOGRAPHS]
    assert set(means) == {"fixed", "per_image"}
    assert min(found["psnr_l"] for found in means.values()) > 34


def test_wrong_lights_cost_what_the_study_measures(
    data: Path,
    studied: tuple[Path, dict],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,  # type: ignore[type-arg]
) -> None:
    """Every reference under the light of the capture's other pose, as if axes were misread."""
    from illuminerf.data import orb_lights

    axes = orb_lights.LIGHT_AXES_FROM_CAMERA * np.array([-1.0, 1.0, -1.0])
    monkeypatch.setattr(orb_lights, "LIGHT_AXES_FROM_CAMERA", axes)
    wrong = orb_illumination_study.study(data, ["cup_scene001"], {}, None, REFERENCES, tmp_path)
    right = studied[1][orb_illumination_study.PHOTOGRAPHS]["fixed"]["psnr_l"]
    assert wrong[orb_illumination_study.PHOTOGRAPHS]["fixed"]["psnr_l"] < right - 4


def test_the_study_goes_on_where_it_stopped(data: Path, studied: tuple[Path, dict]) -> None:  # type: ignore[type-arg]
    out, means = studied
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.exr")}
    assert len(before) >= 4 * 2
    assert orb_illumination_study.study(data, CUPS, {}, None, REFERENCES, out) == means
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.exr")} == before
    assert read_json(out / "study.json")[orb_illumination_study.PHOTOGRAPHS]["fixed"]["mean"] == means[
        orb_illumination_study.PHOTOGRAPHS
    ]["fixed"]  # fmt: skip


def test_the_data_set_is_not_rendered_twice(data: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in data.rglob("*.*")}
    render_synthetic_orb.run(DATA, data)
    assert {path: path.stat().st_mtime_ns for path in data.rglob("*.*")} == before
    assert len(list(data.glob("blender_LDR/*/train/*.png"))) == 2 * DATA.num_views


def test_photographs_show_what_is_behind_the_object(data: Path) -> None:
    view = own_views(data, "cup_scene001")[0]
    folder = data / "blender_LDR" / view.capture
    mask = read_png(folder / "test_mask" / f"{view.name}.png")[..., 0]
    assert 0.1 < mask.mean() < 0.9
    assert read_png(folder / "test" / f"{view.name}.png")[mask == 0].min() > 0.1


def run_benchmark(data: Path, out: Path, monkeypatch: pytest.MonkeyPatch, illumination: str, preset: Preset) -> dict:  # type: ignore[type-arg]
    monkeypatch.setattr(stanford_orb, "customised", lambda *_, **__: preset)
    arguments = ["benchmark", "stanford-orb", str(data), "--objects", "cup_scene001", "--out", str(out)]
    main([*arguments, "--illumination", illumination, "--device", "cpu"])
    return read_json(out / "scores.json")  # type: ignore[no-any-return]


@pytest.mark.slow
@pytest.mark.parametrize("illumination", ["fixed", "per-image"])
def test_the_whole_benchmark_and_again(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, illumination: str
) -> None:
    preset = dataclasses.replace(tiny(), illumination=None)
    scores = run_benchmark(data, tmp_path / "run", monkeypatch, illumination, preset)
    assert scores["images"] == {"cup_scene001": {"cup_scene002": 2}}
    assert scores["missing"] == {"cup_scene001": {"cup_scene002": 0}}
    assert 5 < scores["mean"]["psnr_h"] < 50 and scores["illumination"] == illumination
    assert {"capture", "geometry", "cues", "relit", "latent_nerf", "test_views"} <= set(
        scores["seconds"]["cup_scene001"]
    )
    lights = sorted(path.name for path in (tmp_path / "run" / "cup_scene001" / "lights").iterdir())
    wanted = ["cup_scene002"] if illumination == "fixed" else ["cup_scene002_0000", "cup_scene002_0001"]
    assert lights == wanted
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("DONE")}
    assert run_benchmark(data, tmp_path / "run", monkeypatch, illumination, preset) == scores
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("DONE")} == before


def test_jobs_of_both_illuminations(tmp_path: Path) -> None:
    root = write_orb(tmp_path / "orb")
    cell = relighting_cells(root, ["cup_scene001"])[0]
    (fixed,) = stanford_orb.relighting_jobs(root, cell, "fixed")
    assert fixed.name == "cup_scene002" and fixed.views == cell.views and fixed.light in cell.views
    each = stanford_orb.relighting_jobs(root, cell, "per-image")
    assert [job.name for job in each] == [f"cup_scene002_{name}" for name in NAMES]
    assert [job.views for job in each] == [(view,) for view in cell.views]
    assert [job.light for job in each] == list(cell.views)


def test_renderings_are_scored_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_orb(tmp_path / "orb")
    predict(root, tmp_path / "ours", "duck_scene001", noise=0.1)
    arguments = ["benchmark", "stanford-orb", str(root), "--objects", "duck", "--score", str(tmp_path / "ours")]
    main([*arguments, "--json", str(tmp_path / "scores.json")])
    scores = read_json(tmp_path / "scores.json")
    assert scores["missing"] == {"duck_scene001": {"duck_scene003": 0}, "duck_scene003": {"duck_scene001": 2}}
    text = capsys.readouterr().err
    assert "duck_scene003" in text and "NVDiffRecMC *" in " ".join(text.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give --out"),
        (["--objects", "vase", "--out", "run"], "no object 'vase'"),
        (["--score", "absent"], "no predictions"),
    ],
)
def test_mistakes_are_told_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    root = write_orb(tmp_path / "orb")
    with pytest.raises(SystemExit) as stop:
        main(["benchmark", "stanford-orb", str(root), *arguments])
    assert stop.value.code == 2 and message in " ".join(capsys.readouterr().err.split())


def test_missing_lights_are_found_before_hours_are_spent(tmp_path: Path) -> None:
    root = write_orb(tmp_path / "orb")
    (root / "ground_truth" / "cup_scene002" / "env_map" / "0011.exr").unlink()
    with pytest.raises(UserError, match="env_map/0011.exr"):
        stanford_orb.run(root, ["cup_scene001"], "fixed", tiny(), None, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_missing_mesh_is_found_before_any_reference(tmp_path: Path) -> None:
    root = write_orb(tmp_path / "orb")
    with pytest.raises(UserError, match="mesh is not where it should be"):
        orb_illumination_study.study(root, CUPS, {}, None, REFERENCES, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_published_rows_are_marked_and_ours_are_not() -> None:
    lines = printed(published_orb_table({"psnr_h": 24.0, "psnr_l": 31.5, "ssim": 0.97}, "2 objects")).splitlines()
    for row in STANFORD_ORB:
        assert any(f"{row.method} *" in line and f"{row.psnr_h:.2f}" in line for line in lines)
    ours = next(line for line in lines if "ours" in line)
    assert "*" not in ours and "24.00" in ours and "- " in ours
    means = {"fixed": {"psnr_h": 20.0}, "per_image": {"psnr_h": 21.5}}
    text = printed(study_table({"ours": means}))
    assert "20.00" in text and "21.50" in text and "26.34" in text
    rows = [row for row in ILLUMINATION_STUDY if row.illumination in ("fixed", "per image")]
    assert all((row.fixed[1] > row.per_image[1]) == (row.illumination == "fixed") for row in rows)


def test_cells_are_printed_with_what_is_missing() -> None:
    cell = {"a_scene001": {"a_scene002": 12.5}}
    scores = {"psnr_h": cell, "images": {"a_scene001": {"a_scene002": 7}}, "missing": {"a_scene001": {"a_scene002": 3}}}
    text = printed(capture_table({**scores, "mean": {"psnr_h": 12.5}}))
    assert "12.50" in text and " 7 " in text and " 3 " in text
