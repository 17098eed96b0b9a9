"""The stage writes every view once, goes on where it stopped, and makes the same bytes either way."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from illuminerf.cues.renderer import CUE_CHANNELS, CueSampling
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_exr, write_png
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.stages import render_radiance_cues
from illuminerf.workflow.artefact import fingerprint
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError

CONFIG = render_radiance_cues.Config(sampling=CueSampling(4), exposure_stops=1.0, seed=3)
SIZE, NUM_VIEWS = 16, 3


@pytest.fixture
def inputs(tmp_path: Path) -> tuple[Path, Path, Path]:
    geometry, capture, light = tmp_path / "geometry", tmp_path / "capture", tmp_path / "lamp.exr"
    geometry.mkdir()
    sphere_mesh(2).save_glb(geometry / "mesh.glb")
    cameras = turntable_cameras(NUM_VIEWS, 3.0, 0.8, SIZE, SIZE)
    write_json(capture / "cameras.json", cameras.to_dict())
    names = [f"{view:03d}" for view in range(NUM_VIEWS)]
    write_json(capture / "capture.json", {"scale": 1.0, "offset": [0, 0, 0], "background": "masked", "names": names})
    for name in names:
        write_png(capture / "images" / f"{name}.png", np.ones((SIZE, SIZE, 4), np.float32))
    radiance = np.full((8, 16, 3), 0.1, np.float32)
    radiance[2, 8] = 5
    EnvironmentMap(radiance).save(light)
    return geometry, capture, light


def test_every_view_has_its_channels(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    out = render_radiance_cues.run(*inputs, CONFIG, tmp_path / "cues")
    for view in range(NUM_VIEWS):
        channels = read_exr(render_radiance_cues.cue_path(out, view))
        assert set(channels) == {*CUE_CHANNELS, "A"}
        assert all(channel.shape == (SIZE, SIZE) for channel in channels.values())
        assert channels["A"].max() == 1 and channels["A"][0, 0] == 0
    light = EnvironmentMap.load(out / "light.exr")
    assert light.linear_rgb.max() == pytest.approx(10)
    assert read_json(out / "light.json")["exposure_stops"] == 1


def test_resumed_equals_uninterrupted(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    whole = render_radiance_cues.run(*inputs, CONFIG, tmp_path / "whole")
    broken = render_radiance_cues.run(*inputs, CONFIG, tmp_path / "broken")
    kept = render_radiance_cues.cue_path(broken, 0)
    written = kept.stat().st_mtime_ns
    (broken / "DONE").unlink()
    render_radiance_cues.cue_path(broken, 1).unlink()
    render_radiance_cues.run(*inputs, CONFIG, broken)
    assert kept.stat().st_mtime_ns == written
    assert fingerprint(broken) == fingerprint(whole)


def test_shards_share_the_views_and_make_the_same_bytes(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    whole = render_radiance_cues.run(*inputs, CONFIG, tmp_path / "whole")
    out = tmp_path / "shared"
    for shard, num_views in (("1/2", 1), ("0/2", 3)):
        assert not (out / "DONE").exists()
        render_radiance_cues.run(*inputs, replace(CONFIG, shard=shard), out)
        assert len(list((out / "cues").glob("*.exr"))) == num_views
    assert (out / "DONE").read_bytes() == (whole / "DONE").read_bytes()
    with pytest.raises(UserError, match="0/4"):
        render_radiance_cues.Config(shard="4/4")


def test_a_mesh_that_no_view_sees_is_told(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    mesh = sphere_mesh(2)
    TriangleMesh(mesh.vertices + np.float32(50), mesh.faces, mesh.vertex_normals).save_glb(inputs[0] / "mesh.glb")
    with pytest.raises(UserError, match="no view sees the mesh"):
        render_radiance_cues.run(*inputs, CONFIG, tmp_path / "cues")
    assert not (tmp_path / "cues" / "DONE").exists()


def test_turned_lights_are_other_cues(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    config = render_radiance_cues.Config(sampling=CueSampling(4), light_rotation_radians=np.pi / 2)
    placed = render_radiance_cues.placed_light(inputs[2], config)
    row, column = np.unravel_index(placed.linear_rgb[..., 0].argmax(), (8, 16))
    assert (row, column) == (2, 4)  # a quarter turn counter-clockwise moves the lamp a quarter of the map to the left


def test_large_lights_are_averaged(tmp_path: Path) -> None:
    EnvironmentMap(np.random.default_rng(0).random((24, 48, 3)).astype(np.float32)).save(tmp_path / "big.exr")
    config = render_radiance_cues.Config(max_light_height=10)
    placed = render_radiance_cues.placed_light(tmp_path / "big.exr", config)
    assert placed.linear_rgb.shape == (10, 20, 3)
    assert placed.linear_rgb.mean() == pytest.approx(
        EnvironmentMap.load(tmp_path / "big.exr").linear_rgb.mean(), rel=1e-3
    )


def test_other_settings_are_refused(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    out = render_radiance_cues.run(*inputs, CONFIG, tmp_path / "cues")
    with pytest.raises(UserError, match="exposure_stops"):
        render_radiance_cues.run(*inputs, render_radiance_cues.Config(sampling=CueSampling(4), seed=3), out)
    with pytest.raises(UserError, match="exposure_stops"):
        render_radiance_cues.Config(exposure_stops=float("nan"))
    (inputs[0] / "mesh.glb").unlink()
    with pytest.raises(UserError, match="mesh"):
        render_radiance_cues.run(*inputs, CONFIG, tmp_path / "other")
