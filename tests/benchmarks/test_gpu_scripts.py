"""Each script of benchmarks/gpu, tiny and on a CPU: it ends well, checks itself, and says what it should."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from benchmarks.gpu.carried_folder import differences, pack, unpack
from benchmarks.gpu.render_pairs import check_items
from illuminerf import demo
from illuminerf.scene.relighting_pairs import iterate_items
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import write_items

SCRIPTS = Path(__file__).parents[2] / "benchmarks" / "gpu"


def run(script: str, *arguments: str | Path, statuses: tuple[int, ...] = (0,)) -> dict[str, Any]:
    """The JSON on the last line of a script's output."""
    command = [sys.executable, str(SCRIPTS / script), *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode in statuses, done.stderr[-2000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_kernels_agree_with_their_twins() -> None:
    report = run("check_kernels.py", "--tiny", "--device", "cpu")
    errors = report["relative_errors"]["hash_grid float64"]
    assert report["passed"] and set(errors) == {"features", "jacobian", "gradient", "second_order"}
    assert report["of_a_wrong_second_order"]["hash_grid float64"] > 1e6 * max(errors.values())


def test_fields_are_measured_beside_plain_torch() -> None:
    report = run("../gpu_fields.py", "--tiny", "--device", "cpu")
    assert report["passed"] and min(report["ceilings"].values()) > 0
    for fit in ("geometry", "latent_nerf"):
        precisions = {"float32", "bfloat16"}
        launched = {f"{precision}_not_recorded" for precision in precisions}
        assert report[fit]["minutes"].keys() == {*precisions, *launched, "float32_plain_torch"}
        assert report[fit]["minutes"]["float32"] == pytest.approx(
            25_000 / 60 / report[fit]["steps_per_second"]["float32"], rel=1e-3
        )
    for grid in (report["hash_grid"]["roofline"], report["hash_grid_of_the_surface"]):
        assert 0 < grid["forward"]["least_gb"] < grid["forward_and_backward"]["least_gb"]
    if "not_run" not in report["kernels"]:
        assert max(report["kernels"]["relative_errors"]["triton float64"].values()) < 1e-9


def test_without_a_gpu_the_fields_are_not_measured_and_it_is_said_why() -> None:
    for device, said in (("cuda", "CUDA was asked for"), ("cpu", "this measures a GPU")):
        command = [sys.executable, str(SCRIPTS.parent / "gpu_fields.py"), "--device", device]
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"CUDA_VISIBLE_DEVICES": ""})
        assert done.returncode == 1 and said in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_pairs_are_rendered_until_time_is_up_and_gone_on_with(tmp_path: Path) -> None:
    out = tmp_path / "pairs"
    # status 1 where nothing was rendered in time, which is not a success; a busy machine may end it late
    first = run("render_pairs.py", "--out", out, "--tiny", "--minutes", "0.001", "--workers", "1", statuses=(0, 1))
    before = first["items"]["new"]
    assert first["ended"] == "time is up" and first["passed"] == (before > 0)
    second = run("render_pairs.py", "--out", out, "--tiny", "--minutes", "4", "--workers", "1", "--device", "cpu")
    wanted = {"in_shards": 6, "waiting": 0, "new": 6 - before, "checked": 6}
    assert second["ended"] == "done" and second["items"] == wanted
    assert len(list(iterate_items(out))) == check_items(out) == 6
    shard = out / "pairs-000001.tar"
    shard.write_bytes(shard.read_bytes()[:-1] + b"x")
    with pytest.raises(UserError, match="damaged"):
        check_items(out)


@pytest.mark.slow
def test_training_is_carried_off_and_gone_on_with(tmp_path: Path) -> None:
    pairs = write_items(tmp_path / "pairs")
    carried = tmp_path / "carried"
    options = ("--carried", carried, "--tiny", "--device", "cpu")
    done = run("train_rdm.py", pairs, "--out", tmp_path / "run", *options)
    assert done["ended"] == "done" and done["steps"]["now"] == done["steps"]["wanted"] == 3
    assert not done["too_many_files"] and done["carried"]["largest_bytes"] <= 16 * 2**20
    # as if stopped before the end: the finished marks are gone, the state of the run is there
    for name in ("DONE", "provenance.json"):
        (tmp_path / "run" / name).unlink()
    assert len(pack(tmp_path / "run", carried)) > 2
    again = run("train_rdm.py", pairs, "--out", tmp_path / "elsewhere", *options)
    assert again["resumed_from_carried_files"] and again["steps"]["before"] == 3 and again["ended"] == "done"
    model = "conditioning/diffusion_pytorch_model.safetensors"
    assert (tmp_path / "run" / model).read_bytes() == (tmp_path / "elsewhere" / model).read_bytes()


@pytest.mark.slow
def test_speeds_stand_beside_ceilings(tmp_path: Path) -> None:
    capture = demo.bundled_capture()
    light = capture / "lights" / "evening.exr"
    where = ("--capture", capture, "--light", light, "--out", tmp_path / "run")
    report = run("method.py", "--tiny", "--device", "cpu", *where)
    assert report["passed"] and min(report["ceilings"].values()) > 0 < report["geometry_floor_ms"]
    assert report["speed"]["geometry_rays_per_second"] > 0 < report["relighting_model"]["images_per_second"]["1"]
    assert {"geometry", "cues", "relit", "latent_nerf"} <= set(report["pipeline"]["seconds_by_stage"])


def test_a_folder_comes_back_bit_by_bit(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    (folder / "unet").mkdir(parents=True)
    tensors = {
        "large": torch.randn(300, 7),
        "half": torch.randn(5).half(),
        "empty": torch.zeros(0, 3),
        "step": torch.tensor(7.0),
    }
    save_file(tensors, folder / "unet" / "weights.safetensors", metadata={"illuminerf": "{}"})
    (folder / "config.json").write_text("{}\n")
    (folder / "grid.png").write_bytes(b"not carried")
    files = pack(folder, tmp_path / "carried", limit=2048)
    assert len(files) >= 6 and all(path.stat().st_size < 4096 for path in files[1:])
    unpack(tmp_path / "carried", tmp_path / "back")
    assert differences(folder, tmp_path / "back") == []
    found = load_file(tmp_path / "back" / "unet" / "weights.safetensors")
    assert all(torch.equal(value, found[name]) for name, value in tensors.items())
    # the guard: one bit elsewhere is seen
    found["large"][12, 3] = np.nextafter(np.float32(found["large"][12, 3]), np.float32(np.inf)).item()
    save_file(found, tmp_path / "back" / "unet" / "weights.safetensors", metadata={"illuminerf": "{}"})
    assert differences(folder, tmp_path / "back") == ["unet/weights.safetensors:large"]


def test_damage_on_the_way_is_seen(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    save_file({"a": torch.ones(64)}, tmp_path / "model" / "a.safetensors")
    pack(tmp_path / "model", tmp_path / "carried")
    path = tmp_path / "carried" / "000.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(UserError, match="damaged"):
        unpack(tmp_path / "carried", tmp_path / "back")
    path.unlink()
    with pytest.raises(UserError, match="not a carried folder"):
        unpack(tmp_path / "carried", tmp_path / "back")
