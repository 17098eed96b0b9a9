"""JOBS.yaml: what it means, and that every mistake is told with its line."""

from pathlib import Path

import pytest

from illuminerf.batch.jobs import read_jobs
from illuminerf.demo import bundled_capture
from illuminerf.workflow.errors import UserError

GOOD = f"""
out: s3://bucket/shop/
defaults:
  preset: demo
  lights: [studio, {bundled_capture()}/lights/evening.exr]
  settings: {{geometry.mesh_resolution: 64, cues.max_light_height: 8}}
jobs:
  - capture: photos/mug
  - capture: photos/mug
    name: second
    out: elsewhere
    lights: [lamps]
    samples: 8
    seed: 5
    rotate: 90
    settings:
      geometry.mesh_resolution: 32
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "photos" / "mug").mkdir(parents=True)
    return tmp_path


def test_a_file_becomes_jobs(folder: Path) -> None:
    (folder / "jobs.yaml").write_text(GOOD)
    file = read_jobs(folder / "jobs.yaml")
    first, second = file.jobs
    assert (file.out, first.name, first.out) == ("s3://bucket/shop/", "mug", "s3://bucket/shop/mug")
    assert first.capture == second.capture == str(folder / "photos/mug")
    assert first.light_names == ("studio", "evening") and second.lights == ("lamps",)
    assert first.preset.name == "demo" and first.preset.relighting.num_samples == 4
    assert (first.preset.geometry.mesh_resolution, first.preset.cues.max_light_height) == (64, 8)
    assert second.out == str(folder / "elsewhere") and second.preset.relighting.num_samples == 8
    assert second.preset.geometry.seed == 5 and second.preset.cues.light_rotation_radians == pytest.approx(
        1.5708, abs=1e-4
    )
    assert (second.preset.geometry.mesh_resolution, second.preset.cues.max_light_height) == (32, 8)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("    samples: 8", "    sample: 8", 13, "a job has no key 'sample'; wanted name, capture"),
        ("    samples: 8", "    samples: eight", 13, "'samples' has the wrong type; got str; wanted int"),
        ("    samples: 8", "    samples: 0", 9, "job 'second': num_samples"),
        ("    samples: 8", "    samples: 8\n    samples: 9", 14, "the key 'samples' is there twice"),
        ("  preset: demo", "  preset: best", 8, "job 'mug': unknown preset; got 'best'"),
        ("  preset: demo", "  name: mug", 4, "defaults has no key 'name'"),
        ("    name: second", "    name: mug", 9, "job 'mug': two jobs have this name"),
        ("    name: second", "    name: a/b", 9, "no usable name"),
        ("    name: second", "    name: 007", 10, "'name' has the wrong type; got int; wanted str"),
        ("    lights: [lamps]", "    lights: lamps", 12, "'lights' must be a list; got str"),
        ("    lights: [lamps]", "    lights: [neon]", 9, "job 'second': the light neon does not exist"),
        ("    lights: [lamps]", "    lights: [lamps, lamps]", 9, "two lights have the same name"),
        ("    lights: [lamps]", "    lights: []", 9, "no light was given"),
        ("photos/mug\n    name", "photos/cup\n    name", 9, "the capture does not exist"),
        ("  - capture: photos/mug\n    name", "  - name", 9, "a job has no 'capture'"),
        ("out: s3://bucket/shop/", "", 3, "the key 'out' is missing"),
        ("      geometry.mesh_resolution: 32", "      geometry.mesh: 32", 9, "Config has no field 'mesh'"),
        ("    rotate: 90", "    rotate: [", 17, "not valid YAML"),
        ("    rotate: 90", "    rotate: !!python/object/apply:os.getcwd []", 15, "not valid YAML"),
        ("    rotate: 90", "    mesh: mug.glb", 9, "the mesh does not exist"),
        ("    rotate: 90", "    model: mine", 9, "holds no relighting model"),
        ("    rotate: 90", "    device: tpu", 9, "unknown device"),
    ],
)
def test_mistakes_are_told_with_their_line(folder: Path, old: str, new: str, line: int, message: str) -> None:
    assert old in GOOD
    (folder / "jobs.yaml").write_text(
        GOOD.replace(old, new) if "photos/mug" not in old else new.join(GOOD.rsplit(old, 1))
    )
    with pytest.raises(UserError) as error:
        read_jobs(folder / "jobs.yaml")
    assert message in str(error.value)
    assert f"line {line}" in str(error.value)


def test_files_that_are_no_jobs_are_explained(tmp_path: Path) -> None:
    for content, message in (
        (None, "cannot be read"),
        ("", "is empty"),
        ("- a", "the file must have keys"),
        ("out: a", "'jobs' is missing"),
        ("out: a\njobs: []", "at least one job"),
    ):
        if content is not None:
            (tmp_path / "jobs.yaml").write_text(content)
        with pytest.raises(UserError, match=message):
            read_jobs(tmp_path / "jobs.yaml")
