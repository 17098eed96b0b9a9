"""The ablation, tiny: all rows on one set of samples, scored like the benchmark, resumable."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from illuminerf import ablation, demo
from illuminerf.data.capture import load_capture
from illuminerf.data.developing import shrunk
from illuminerf.diffusion.relighting_model import save_model
from illuminerf.evaluation.published import ABLATION
from illuminerf.evaluation.tables import ablation_table
from illuminerf.presets import Preset, customised
from illuminerf.scene.images import write_png
from illuminerf.stages import measure_consistency
from illuminerf.stages.relight_views import sample_path
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import tiny_model, with_noise_in_every_weight
from tests.test_pipeline import LIGHT, NUM_VIEWS, few_photographs, tiny

SIZE = 32
COMPARISON = measure_consistency.Config(num_pairs=1, tolerance=0.2, num_codes=2, num_code_views=1, device="cpu")


def write_benchmark_scene(root: Path) -> Path:
    """The bundled capture in the benchmark's layout: the first photographs, and two test views under the light."""
    photographs = few_photographs(root / "photographs")
    test = demo.bundled_capture() / "test" / LIGHT.stem
    for split, light, source, numbers in (
        ("train", "sunset", photographs, range(NUM_VIEWS)),
        ("test", LIGHT.stem, test, (0, 1)),
    ):
        cameras = read_json(source / "cameras.json")
        for number in numbers:
            frame = cameras["frames"][number]
            folder = root / "mug" / f"{split}_{number:03d}"
            folder.mkdir(parents=True)
            shutil.copy(source / "images" / f"{number:03d}.png", folder / f"rgba_{light}.png")
            content = {
                "cam_transform_mat": ",".join(str(x) for row in frame["world_from_camera"] for x in row),
                "cam_angle_x": 2 * float(np.arctan(0.5 * cameras["width"] / frame["intrinsics"]["fx"])),
                "imw": cameras["width"],
                "imh": cameras["height"],
            }
            (folder / "metadata.json").write_text(json.dumps(content))
    return root / "mug"


def settings(root: Path) -> Preset:
    """All stages, tiny, with a relighting model that is not trained."""
    if not (root / "model").exists():
        save_model(with_noise_in_every_weight(tiny_model()), root / "model")
    preset = tiny(samples=2)
    # enough steps that codes show in 8-bit images: after a dozen, shuffled ones still render the same bytes
    steps = dataclasses.replace(preset.latent_nerf.optimiser, num_steps=80)
    latent_nerf = dataclasses.replace(preset.latent_nerf, optimiser=steps)
    return dataclasses.replace(preset, latent_nerf=latent_nerf, relighting_model=str(root / "model"))


def compare(scene: Path, out: Path) -> None:
    ablation.ablation_command(scene, LIGHT, out, (1, 2), size=SIZE, pairs=1, device="cpu")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(scene, run)."""
    root = tmp_path_factory.mktemp("ablation")
    (root / "photographs").mkdir()
    scene = write_benchmark_scene(root)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "customised", lambda *_, **__: settings(root))
        compare(scene, root / "run")
    return scene, root / "run"


def test_every_row_is_scored_and_stands_beside_the_published_one(finished: tuple[Path, Path]) -> None:
    result = read_json(finished[1] / "ablation" / LIGHT.stem / "ablation.json")
    rows = result["rows"]
    made = [(row["num_samples"], row["uses_latents"], row["shuffles_latents"]) for row in rows]
    assert made == [(1, False, False), (1, True, False), (2, True, False), (2, True, True)]
    assert all(5 < row["psnr"] < 50 and 0 < row["ssim"] < 1 and row["train_psnr"] > 5 for row in rows)
    assert len({row["psnr"] for row in rows}) == 4
    assert [row["published"] and row["published"]["psnr"] for row in rows] == [24.957, 26.321, None, None]
    assert {"cues", "relit", "geometry"} <= set(result["shared_seconds"])
    assert [row["consistency"]["codes_alpha"] for row in rows] == [None, 0, 0, 0]
    assert ablation_table(rows).row_count == 4


def test_a_row_with_fewer_samples_sees_the_first_ones(finished: tuple[Path, Path]) -> None:
    out = finished[1]
    relit, first = out / "lights" / LIGHT.stem / "relit", out / "ablation" / LIGHT.stem / "first_01"
    assert len(list((relit / "samples").iterdir())) == 2 * NUM_VIEWS
    assert len(list((first / "samples").iterdir())) == NUM_VIEWS
    for view in range(NUM_VIEWS):
        assert sample_path(first, view, 0).read_bytes() == sample_path(relit, view, 0).read_bytes()
    with pytest.raises(UserError, match="too few samples"):
        ablation.first_samples(relit, NUM_VIEWS, 3, out / "first_03")


def test_a_second_run_loads_everything(finished: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    scene, out = finished
    monkeypatch.setattr(ablation, "customised", lambda *_, **__: settings(scene.parent))
    result = (out / "ablation" / LIGHT.stem / "ablation.json").read_bytes()
    before = {path: path.stat().st_mtime_ns for path in out.rglob("DONE")}
    compare(scene, out)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("DONE")} == before and len(before) > 12
    assert (out / "ablation" / LIGHT.stem / "ablation.json").read_bytes() == result


def test_other_captures_are_scored_against_a_folder(finished: tuple[Path, Path], tmp_path: Path) -> None:
    scene, out = finished
    shutil.copytree(out, tmp_path / "run", ignore=shutil.ignore_patterns("ablation"))
    test = demo.bundled_capture() / "test" / LIGHT.stem
    cameras = load_capture(test).views.cameras[[0]].resized(SIZE, SIZE)
    views = load_capture(test).views
    write_json(tmp_path / "truth" / "cameras.json", cameras.to_dict())
    image = np.dstack([views.srgb[0], views.alpha[0]])
    write_png(tmp_path / "truth" / "images" / "000.png", shrunk(image, SIZE))
    unseen = ablation.UnseenViews(tmp_path / "truth" / "cameras.json", tmp_path / "truth")
    rows = [ablation.Row(2, uses_latents=False)]
    result = ablation.run(scene, LIGHT, rows, unseen, settings(scene.parent), COMPARISON, tmp_path / "run")
    assert 5 < result["rows"][0]["psnr"] < 50


def test_the_default_rows_are_the_papers_and_the_shuffled_one() -> None:
    rows = ablation.rows_of((16, 4, 1))
    assert [(row.num_samples, row.uses_latents) for row in rows[:-1]] == [
        (row.num_samples, row.uses_latents) for row in ABLATION
    ]
    assert rows[-1] == ablation.Row(16, shuffles_latents=True)
    assert len({row.name for row in rows}) == 5


def test_a_light_without_truth_is_refused_before_any_work(finished: tuple[Path, Path], tmp_path: Path) -> None:
    other = shutil.copy(LIGHT, tmp_path / "dawn.exr")
    with pytest.raises(UserError, match="no image under the light 'dawn'"):
        ablation.ablation_command(finished[0], Path(other), tmp_path / "run", (1,), device="cpu")
    assert not (tmp_path / "run").exists()


def test_samples_can_be_asked_to_differ_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, asked = write_benchmark_scene(tmp_path), []

    def noted(capture: Path, light: Path, rows: Any, views: Any, preset: Preset, *others: Any) -> dict[str, Any]:
        asked.append(preset.relighting.temperature)
        raise UserError("enough")

    monkeypatch.setattr(ablation, "run", noted)
    for temperature in (None, 1.0):
        with pytest.raises(UserError, match="enough"):
            ablation.ablation_command(
                scene, LIGHT, tmp_path / "run", (1,), size=SIZE, temperature=temperature, device="cpu"
            )
    assert asked == [customised("embedded").relighting.temperature, 1.0] and asked[0] != 1.0
