"""Training pairs: the items' form, their determinism, resuming, damage, and broken objects by name."""

import contextlib
import errno
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual.material import PBRMaterial

from illuminerf.cues import shard_driver, training_shards
from illuminerf.cues.object_views import ViewSettings
from illuminerf.cues.renderer import CueSampling
from illuminerf.cues.variations import MaterialVariation
from illuminerf.data.object_collection import ObjectChoice
from illuminerf.diffusion.training_items import load_items
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.relighting_pairs import iterate_items
from illuminerf.stages import render_training_pairs
from illuminerf.stages.render_training_pairs import Config
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.task_pool import Crash, Execution

VIEWS = ViewSettings(
    num_views=2, num_lights=2, size=24, samples_per_pixel=4, cue_sampling=CueSampling(4), light_height=8
)
CONFIG = Config(VIEWS, objects_per_shard=2)


def write_object(folder: Path, name: str, mesh: trimesh.Trimesh, **material: Any) -> None:
    values = {"baseColorFactor": [0.8, 0.3, 0.1, 1.0], "roughnessFactor": 0.6} | material
    mesh.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(**values))
    content = trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True)
    (folder / f"{name}.glb").write_bytes(content)


def write_assets(folder: Path) -> tuple[Path, Path]:
    models, lights = folder / "models", folder / "lights"
    models.mkdir()
    write_object(models, "ball", trimesh.creation.icosphere(2))
    write_object(models, "cube", trimesh.creation.box())
    write_object(models, "cone", trimesh.creation.cone(1.0, 2.0))
    (models / "broken.glb").write_bytes(b"nothing")
    generator = np.random.default_rng(0)
    for name in ("noon", "dusk", "night"):
        EnvironmentMap(generator.random((8, 16, 3)).astype(np.float32), name).save(lights / f"{name}.exr")
    return models, lights


@pytest.fixture
def assets(tmp_path: Path) -> tuple[Path, Path]:
    return write_assets(tmp_path)


def shards(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(out.glob("pairs-*"))}


def test_items_hold_what_training_needs(assets: tuple[Path, Path], tmp_path: Path) -> None:
    config = replace(CONFIG, views=replace(VIEWS, materials=MaterialVariation.none()))
    out = tmp_path / "pairs"
    render_training_pairs.run(*assets, config, out)
    manifest = read_json(out / "manifest.json")
    assert manifest["num_items"] == 6 and manifest["num_ordered_pairs"] == 12
    assert list(manifest["left_out"]) == ["broken_0", "broken_1"] and sum(manifest["left_out_by_reason"].values()) == 2
    assert "broken.glb" in manifest["left_out"]["broken_0"]["message"]
    assert sorted(path.name for path in out.iterdir() if path.suffix == ".tar") == list(
        map("{}.tar".format, manifest["shards"])
    )
    assert not (out / "staging").exists()
    items = {key: (arrays, metadata) for key, arrays, metadata in iterate_items(out)}
    assert sorted(items) == ["ball_0", "ball_1", "cone_0", "cone_1", "cube_0", "cube_1"]
    arrays, metadata = items["ball_0"]
    shapes = {name: (array.shape, array.dtype.name) for name, array in arrays.items()}
    assert shapes == {
        "targets": ((2, 3, 24, 24), "float16"),
        "cues": ((2, 12, 24, 24), "float16"),
        "alpha": ((24, 24), "uint8"),
        "albedo": ((3, 24, 24), "uint8"),
        "roughness": ((24, 24), "uint8"),
        "metallic": ((24, 24), "uint8"),
        "normal": ((3, 24, 24), "float16"),
    }
    assert metadata["object"] == "ball" and metadata["split"] == "train" and metadata["variations"] == []
    assert metadata["lights"][0]["name"] != metadata["lights"][1]["name"] and len(metadata["object_sha256"]) == 64
    _, directions = Cameras.from_dict(metadata["camera"]).image_rays(0)
    assert (arrays["normal"].astype(np.float32).transpose(1, 2, 0) * directions.numpy()).sum(-1).max() <= 1e-2
    assert 0.4 < (arrays["alpha"] == 255).mean() < 0.9
    assert len(load_items(out, 24)) == 6


def test_a_diffuse_object_is_albedo_times_its_cue(assets: tuple[Path, Path], tmp_path: Path) -> None:
    """Targets and cues are made separately, so agreement holds axes, light and exposure together."""
    views = replace(VIEWS, num_views=1, samples_per_pixel=64, cue_sampling=CueSampling(64))
    config = Config(
        replace(views, materials=MaterialVariation.none()), choice=ObjectChoice(excluded=("cube", "cone", "broken"))
    )
    write_object(assets[0], "ball", trimesh.creation.icosphere(3), roughnessFactor=1.0, metallicFactor=0.0)
    render_training_pairs.run(*assets, config, tmp_path / "pairs")
    ((_, arrays, _),) = iterate_items(tmp_path / "pairs")
    inside = arrays["alpha"] == 255
    targets, cues = (arrays[name].astype(np.float32)[:, 0][:, inside] for name in ("targets", "cues"))
    ratio = targets / cues
    assert abs(np.median(ratio) - 0.8) < 0.08 and ratio.std() < 0.12
    assert np.abs(targets / cues[::-1] - 0.8).mean() > np.abs(ratio - 0.8).mean()
    assert read_json(tmp_path / "pairs" / "manifest.json")["excluded"] == ["broken", "cone", "cube"]


def test_however_it_is_made_the_bytes_are_the_same(assets: tuple[Path, Path], tmp_path: Path) -> None:
    render_training_pairs.run(*assets, CONFIG, tmp_path / "here")
    render_training_pairs.run(*assets, CONFIG, tmp_path / "spread", Execution(workers=2))
    render_training_pairs.run(*assets, CONFIG, f"file://{tmp_path}/url")
    assert shards(tmp_path / "here") == shards(tmp_path / "spread") == shards(tmp_path / "url")
    assert len(shards(tmp_path / "here")) == 4
    other = replace(CONFIG, views=replace(VIEWS, seed=1))
    render_training_pairs.run(*assets, other, tmp_path / "other")
    assert shards(tmp_path / "other") != shards(tmp_path / "here")


class StoppedError(Exception):
    """Stands in for a power cut."""


def test_interrupted_and_resumed_equals_uninterrupted(
    assets: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render_training_pairs.run(*assets, CONFIG, tmp_path / "whole")
    out = tmp_path / "stopped"
    real = training_shards.render_views
    for _ in range(3):  # one more item each time
        made: list[int] = []

        def stopping(*arguments: Any, made: list[int] = made) -> Any:
            for view, files in real(*arguments):
                if made:
                    raise StoppedError
                made.append(view)
                yield view, files

        monkeypatch.setattr(training_shards, "render_views", stopping)
        with pytest.raises(StoppedError):
            render_training_pairs.run(*assets, CONFIG, out)
        monkeypatch.setattr(training_shards, "render_views", real)
        assert not (out / "DONE").exists()
    render_training_pairs.run(*assets, CONFIG, out)
    assert shards(out) == shards(tmp_path / "whole") and not (out / "staging").exists()
    assert (out / "DONE").read_bytes() == (tmp_path / "whole" / "DONE").read_bytes()


def test_finished_shards_stay_and_damaged_ones_are_made_again(assets: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "pairs"
    render_training_pairs.run(*assets, CONFIG, out)
    before = shards(out)
    times = {path: path.stat().st_mtime_ns for path in out.glob("pairs-*.tar")}
    render_training_pairs.run(*assets, CONFIG, out)
    assert {path: path.stat().st_mtime_ns for path in times} == times
    damaged, kept = sorted(times)
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(UserError, match="damaged"):
        list(iterate_items(out))
    render_training_pairs.run(*assets, CONFIG, out)
    assert shards(out) == before and kept.stat().st_mtime_ns == times[kept]


def test_a_lost_manifest_is_written_again(assets: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "pairs"
    render_training_pairs.run(*assets, CONFIG, out)
    whole, times = (out / "manifest.json").read_bytes(), [p.stat().st_mtime_ns for p in out.glob("*.tar")]
    for spoil in (Path.unlink, lambda path: path.write_text("garbage")):
        spoil(out / "manifest.json")
        render_training_pairs.run(*assets, CONFIG, out)
        assert (out / "manifest.json").read_bytes() == whole
    assert [p.stat().st_mtime_ns for p in out.glob("*.tar")] == times


def test_a_shard_of_other_objects_is_made_again(assets: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "pairs"
    render_training_pairs.run(*assets, CONFIG, out)
    before = shards(out)
    index = read_json(out / "pairs-000000.json")
    index["keys"][0] = "stranger_0"
    (out / "pairs-000000.json").write_text(json.dumps(index))
    render_training_pairs.run(*assets, CONFIG, out)
    assert shards(out) == before


def test_packing_twice_changes_nothing(
    assets: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, real = tmp_path / "pairs", shard_driver.pack_shard

    def pack_twice(task: Any) -> Any:
        first = real(task)
        times = (out / f"{task.shard}.tar").stat().st_mtime_ns
        (out / "staging/lights/.noon.x.partial.npy").write_bytes(b"of a killed process")
        assert real(task) == first and (out / f"{task.shard}.tar").stat().st_mtime_ns == times
        return first

    monkeypatch.setattr(shard_driver, "pack_shard", pack_twice)
    render_training_pairs.run(*assets, CONFIG, out)
    assert not (out / "staging").exists()


def test_a_crash_costs_one_view(assets: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that dies at the second view of the cube; first and third are rendered all the same."""
    config = replace(CONFIG, views=replace(VIEWS, num_views=3), choice=ObjectChoice(excluded=("broken",)))
    real = shard_driver.render_object

    def dying(task: Any) -> Any:
        plan = training_shards.read_plan(task.out, task.plan)
        folder = tmp_path / "out" / "staging" / plan.shard_name(task.index)
        if plan.objects[task.index].id != "cube" or (folder / "cube_1.json").exists():
            return real(task)
        views = training_shards.render_views
        monkeypatch.setattr(training_shards, "render_views", lambda *a: itertools.islice(views(*a), 1))
        real(task)
        monkeypatch.setattr(training_shards, "render_views", views)
        return Crash("killed by the test")

    monkeypatch.setattr(shard_driver, "render_object", dying)
    render_training_pairs.run(*assets, config, tmp_path / "out")
    manifest = read_json(tmp_path / "out" / "manifest.json")
    assert manifest["left_out"] == {"cube_1": {"reason": "crash", "message": "killed by the test"}}
    assert manifest["num_items"] == 8


def test_where_nothing_can_be_rendered_the_run_stops(assets: tuple[Path, Path], tmp_path: Path) -> None:
    config = replace(CONFIG, choice=ObjectChoice(excluded=("ball", "cone", "cube")))
    with pytest.raises(UserError, match="not one object could be rendered.*broken.glb"):
        render_training_pairs.run(*assets, config, tmp_path / "a")
    assert not (tmp_path / "a" / "DONE").exists()
    for index in range(25):
        (assets[0] / f"a{index}.glb").write_bytes(b"nothing")
    many = replace(CONFIG, choice=ObjectChoice(excluded=("ball", "cone", "cube")))
    with pytest.raises(UserError, match="not one object could be rendered"):
        render_training_pairs.run(*assets, many, tmp_path / "b")
    assert not list((tmp_path / "b").glob("*.tar")) or len(list((tmp_path / "b").glob("*.tar"))) < 13


def test_odd_names_and_dangling_links(assets: tuple[Path, Path], tmp_path: Path) -> None:
    write_object(assets[0], "chair.v2 [b]", trimesh.creation.box())
    write_object(assets[0], "n" * 200, trimesh.creation.box())
    (assets[0] / "gone.glb").symlink_to(tmp_path / "nowhere.glb")
    out = tmp_path / "pairs"
    with pytest.raises(UserError, match=r"gone\.glb"):
        render_training_pairs.run(*assets, CONFIG, out)
    (assets[0] / "gone.glb").unlink()
    render_training_pairs.run(*assets, CONFIG, tmp_path / "again")
    keys = [key for key, _, _ in iterate_items(tmp_path / "again")]
    assert "chair_v2__b__0" in keys and any(key.startswith("n" * 100) and len(key) < 130 for key in keys)


def test_a_folder_of_something_else_is_left_alone(assets: tuple[Path, Path], tmp_path: Path) -> None:
    home = tmp_path / "home"
    (home / "other_run").mkdir(parents=True)
    half_written = home / "other_run" / ".x.partial.exr"
    half_written.write_bytes(b"being written")
    with pytest.raises(UserError, match="not a run of this program; got other_run"):
        render_training_pairs.run(*assets, CONFIG, home)
    assert half_written.exists() and sorted(p.name for p in home.iterdir() if p.name != ".lock") == ["other_run"]


def test_a_damaged_staged_item_is_made_again(
    assets: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render_training_pairs.run(*assets, CONFIG, tmp_path / "whole")
    out, real = tmp_path / "pairs", shard_driver.pack_shard

    def spoil_then_pack(task: Any) -> Any:
        staged = sorted((out / "staging" / task.shard).glob("*.item"))[0]
        content = bytearray(staged.read_bytes())
        content[-700] ^= 255
        staged.write_bytes(content)
        monkeypatch.setattr(shard_driver, "pack_shard", real)
        return real(task)

    monkeypatch.setattr(shard_driver, "pack_shard", spoil_then_pack)
    render_training_pairs.run(*assets, CONFIG, out)
    assert shards(out) == shards(tmp_path / "whole")


def test_a_full_disk_is_explained_and_loses_nothing(
    assets: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render_training_pairs.run(*assets, CONFIG, tmp_path / "whole")
    out, real = tmp_path / "full", Path.write_bytes

    def write(path: Path, content: bytes) -> int:
        if len(list(out.glob("staging/*/[!.]*.item"))) >= 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, content)

    monkeypatch.setattr(Path, "write_bytes", write)
    with pytest.raises(UserError, match="the disk is full"):
        render_training_pairs.run(*assets, CONFIG, out)
    monkeypatch.setattr(Path, "write_bytes", real)
    assert len(list(out.glob("staging/*/*.item"))) == 2 and not list(out.rglob("*.partial*"))
    render_training_pairs.run(*assets, CONFIG, out)
    assert shards(out) == shards(tmp_path / "whole")


@pytest.mark.slow
def test_killed_again_and_again_the_bytes_are_the_same(assets: tuple[Path, Path], tmp_path: Path) -> None:
    """SIGKILL of the whole process group, at growing numbers of finished items."""
    render_training_pairs.run(*assets, CONFIG, tmp_path / "whole")
    out = tmp_path / "killed"
    code = (
        "from tests.stages.test_render_training_pairs import *; import sys; from pathlib import Path; "
        "render_training_pairs.run(Path(sys.argv[1]), Path(sys.argv[2]), CONFIG, sys.argv[3], Execution(workers=2))"
    )
    command = [sys.executable, "-c", code, *map(str, assets), str(out)]
    for num_items in (1, 3, 5):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
        while process.poll() is None and len(list(out.glob("staging/*/*.item"))) < num_items:
            time.sleep(0.02)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    render_training_pairs.run(*assets, CONFIG, out)
    assert shards(out) == shards(tmp_path / "whole") and not list(out.rglob("*.partial*"))


def test_unusable_lights_are_left_out_by_name(assets: tuple[Path, Path], tmp_path: Path) -> None:
    from illuminerf.scene.images import write_exr

    for name, image in (("tiny", np.ones((1, 1), np.float32)), ("hole", np.full((8, 16), np.nan, np.float32))):
        write_exr(assets[1] / f"{name}.exr", dict.fromkeys("RGB", image))
    config = replace(CONFIG, choice=ObjectChoice(excluded=("broken", "cone", "cube")))
    render_training_pairs.run(*assets, config, tmp_path / "pairs")
    manifest = read_json(tmp_path / "pairs" / "manifest.json")
    assert sorted(manifest["lights_left_out"]) == ["hole", "tiny"] and manifest["lights"] == ["dusk", "night", "noon"]


def test_wrong_inputs_are_explained(assets: tuple[Path, Path], tmp_path: Path) -> None:
    run = render_training_pairs.run
    with pytest.raises(UserError, match="holds no objects"):
        run(assets[1], assets[1], CONFIG, tmp_path / "a")
    with pytest.raises(UserError, match="too few lights"):
        run(*assets, replace(CONFIG, views=replace(VIEWS, num_lights=4)), tmp_path / "b")
    with pytest.raises(UserError, match="two lights"):
        ViewSettings(num_lights=1)
    with pytest.raises(UserError, match="objects_per_shard"):
        Config(objects_per_shard=0)
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="not a run of this program"):
        run(*assets, CONFIG, tmp_path / "c")
    config = replace(CONFIG, choice=ObjectChoice(excluded=("broken", "cone", "cube")))
    run(*assets, config, tmp_path / "d")
    with pytest.raises(UserError, match="views.seed is 0 there and 3 here"):
        run(*assets, replace(config, views=replace(VIEWS, seed=3)), tmp_path / "d")
    write_object(assets[0], "newcomer", trimesh.creation.box())
    with pytest.raises(UserError, match="input 'objects' has changed"):
        run(*assets, config, tmp_path / "d")
