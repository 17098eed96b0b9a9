"""A made-up capture of a model: photographs, truth, the light's exposure; resumable."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.data.capture import load_capture
from illuminerf.data.reading import read_source
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_exr, read_png
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.scene.procedural import studio_light
from illuminerf.stages import render_object_capture
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError

CONFIG = render_object_capture.Config(
    num_views=4, num_test_views=2, size=24, samples_per_pixel=4, max_light_height=16, device="cpu"
)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(model, light): a sphere of radius 3, which is brought to 1, under a light of mean radiance 5."""
    folder = tmp_path_factory.mktemp("inputs")
    sphere_mesh(3, 3.0).save_glb(folder / "ball.glb")
    light = studio_light(16)
    EnvironmentMap(light.linear_rgb * np.float32(5 / light.mean_radiance().mean()), "studio").save(
        folder / "studio.exr"
    )
    return folder / "ball.glb", folder / "studio.exr"


@pytest.fixture(scope="module")
def capture(inputs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_object_capture.run(*inputs, CONFIG, tmp_path_factory.mktemp("made") / "capture")


def test_the_truth_lies_in_the_world_of_the_cameras(capture: Path) -> None:
    truth = TriangleMesh.load_glb(capture / "truth" / "mesh.glb")
    np.testing.assert_allclose(np.linalg.norm(truth.vertices, axis=-1), 1, atol=0.01)
    cameras = Cameras.from_dict(read_json(capture / "test" / "cameras.json"))
    for view in range(2):
        found = read_exr(capture / "test" / "normals" / f"{view:03d}.exr")
        normals, covered = np.stack([found[axis] for axis in "XYZ"], -1), found["A"] > 0.99
        photograph = read_png(capture / "test" / "images" / f"{view:03d}.png")
        assert np.abs(photograph[..., 3] - found["A"]).max() < 0.5 and covered.sum() > 100
        middle = normals[12, 12] @ (cameras.positions[view] / np.linalg.norm(cameras.positions[view]))
        assert middle > 0.98


def test_the_capture_can_be_read_and_its_cameras_look_from_above(capture: Path) -> None:
    source = read_source(capture, None, "train", "sunset", "masks")
    assert len(source.frames) == 4 and len(load_capture(capture / "test").views) == 2
    for folder, count in ((capture, 4), (capture / "test", 2)):
        positions = Cameras.from_dict(read_json(folder / "cameras.json")).positions
        assert len(positions) == count and (positions[:, 2] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(positions, axis=-1), render_object_capture.DISTANCE)


def test_the_light_is_exposed(capture: Path) -> None:
    assert EnvironmentMap.load(capture / "light.exr").mean_radiance().mean() == pytest.approx(0.8, rel=1e-3)


def test_all_around_is_from_below_too(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    out = render_object_capture.run(*inputs, replace(CONFIG, places="all", num_views=8), tmp_path / "all")
    assert Cameras.from_dict(read_json(out / "cameras.json")).positions[:, 2].min() < 0


def test_a_killed_capture_goes_on_to_the_same_bytes(
    inputs: tuple[Path, Path], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(*_: object) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "capture"
    monkeypatch.setattr(render_object_capture, "_draw_normals", dies)
    with pytest.raises(KeyboardInterrupt):
        render_object_capture.run(*inputs, CONFIG, out)
    monkeypatch.undo()
    (out / "images" / "002.png").unlink()
    render_object_capture.run(*inputs, CONFIG, out)
    assert (out / "DONE").read_text() == (capture / "DONE").read_text()
    other = render_object_capture.run(*inputs, replace(CONFIG, seed=1), tmp_path / "other")
    assert (other / "DONE").read_text() != (capture / "DONE").read_text()


def test_a_broken_model_leaves_nothing_behind(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "broken.glb").write_bytes(b"no model")
    with pytest.raises(BrokenObject):
        render_object_capture.run(tmp_path / "broken.glb", inputs[1], CONFIG, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(UserError, match="too small"):
        replace(CONFIG, num_views=2)
