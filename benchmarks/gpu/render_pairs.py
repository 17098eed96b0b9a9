"""Training pairs for as long as a time budget lasts, by the fastest of Mitsuba's variants that starts; prints JSON.

python benchmarks/gpu/render_pairs.py [OBJECTS LIGHTS] --out OUT [--minutes 8] [--device auto] [--workers 0] [--tiny]
    [-- any option of `illuminerf render-training-pairs`]

Without folders it takes objects and lights made from formulas (written beside OUT). Run it again to go
on. Exit status 1 where a finished shard is damaged or an item does not hold what it must.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.scene.example_assets import write_example_assets
from illuminerf.scene.relighting_pairs import decode_item
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.shards import finished_shards, read_samples, read_shard
from illuminerf.workflow.storage import Storage

_STOP_SECONDS = 30
_PROBE = """
import sys
from illuminerf.cues.mitsuba_variant import load_mitsuba
mitsuba = load_mitsuba(sys.argv[1])
scene = mitsuba.load_dict(mitsuba.cornell_box())
import numpy
assert numpy.isfinite(numpy.array(mitsuba.render(scene, spp=1))).all()
print(mitsuba.variant())
"""
_TINY = "--views.num-views 1 --views.num-lights 2 --views.size 16 --views.samples-per-pixel 2"
_TINY += " --views.cue-sampling.samples-per-pixel 2 --views.light-height 8 --objects-per-shard 2"


def probe(device: str) -> dict[str, Any]:
    """Whether Mitsuba renders anything on `device`, in a process of its own, since a bad driver may end it."""
    try:
        done = subprocess.run([sys.executable, "-c", _PROBE, device], capture_output=True, text=True, timeout=240)
    except subprocess.TimeoutExpired:
        return {"device": device, "starts": False, "why": "no picture after 240 s"}
    if done.returncode == 0:
        return {"device": device, "starts": True, "variant": done.stdout.split()[-1]}
    why = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[-1]
    return {"device": device, "starts": False, "why": why}


def count_items(out: Path) -> tuple[int, int]:
    """Items in finished shards, and items that wait for theirs."""
    in_shards = sum(len(index.keys) for index in finished_shards(Storage(out))) if out.is_dir() else 0
    return in_shards, sum(1 for _ in out.glob("staging/*/*.item"))


def check_items(out: Path) -> int:
    """Read every finished shard; the number of items that were checked.

    Raises:
        UserError: a shard is damaged.
        AssertionError: an item has no covered pixel, no light or a value that is not finite.
    """
    storage, checked = Storage(out), 0
    for index in finished_shards(storage):
        for key, files in read_shard(storage, index):
            arrays = decode_item(files["safetensors"], key)
            assert (arrays["alpha"] > 127).any(), f"{key} shows nothing"
            assert all(np.isfinite(array.astype(np.float32)).all() for array in arrays.values()), f"{key} is not finite"
            assert arrays["cues"].astype(np.float32).max() > 0 and arrays["targets"].max() > 0, f"{key} has no light"
            checked += 1
    for path in sorted(out.glob("staging/*/*.item")):  # a digest of 32 bytes, then a little tar
        assert len(list(read_samples(path.read_bytes()[32:]))) == 1, f"{path.name} is damaged"
        checked += 1
    return checked


def render(command: list[str], seconds: float, log: Path) -> str:
    """Run the factory until it is done or time is up; how it ended."""
    with open(log, "ab") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream, start_new_session=True)
        try:
            status = process.wait(timeout=seconds)
            return "done" if status == 0 else f"exit status {status}, see {log}"
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)  # what Ctrl-C does: finished items stay
        try:
            process.wait(timeout=_STOP_SECONDS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return "time is up"


def parsed() -> tuple[argparse.Namespace, list[str]]:
    """The command line, and what stands after `--`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*", metavar="FOLDER", help="OBJECTS and LIGHTS")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="auto: cuda, else cpu")
    parser.add_argument("--workers", type=int, default=0, help="processes; 0: one on a GPU, else one per core")
    parser.add_argument("--tiny", action="store_true", help="16 x 16 pixels, 2 paths")
    arguments = sys.argv[1:]
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    options, more = parser.parse_args(arguments[:cut]), arguments[cut + 1 :]
    if len(options.folders) not in (0, 2):
        parser.error("name OBJECTS and LIGHTS, or neither")
    return options, more


def asset_folders(options: argparse.Namespace) -> list[Path]:
    """Those that were named, or made-up ones beside the pairs; they are not written twice, so that runs go on."""
    if options.folders:
        return list(options.folders)
    beside = options.out.parent / f"{options.out.name}_assets"
    folders = [beside / "objects", beside / "lights"]
    if not all(folder.is_dir() for folder in folders):
        write_example_assets(beside, *((32, 16) if options.tiny else ()))
    return folders


def main() -> None:
    options, more = parsed()
    tried = []
    for device in ("cuda", "cpu") if options.device == "auto" else (options.device,):
        tried.append(probe(device))
        if tried[-1]["starts"]:
            break
    else:
        print(json.dumps({"passed": False, "tried": tried}))
        sys.exit(1)
    workers = options.workers or (1 if device == "cuda" else os.cpu_count() or 1)
    command = [sys.executable, "-c", "from illuminerf.cli import main; main()", "render-training-pairs"]
    command += [*map(str, asset_folders(options))]
    command += ["--out", str(options.out), "--workers", str(workers), "--views.cue-sampling.device", device]
    command += (_TINY.split() if options.tiny else []) + more
    before, start = sum(count_items(options.out)), time.monotonic()
    ended = render(command, 60 * options.minutes, options.out.parent / f"{options.out.name}.log")
    minutes = (time.monotonic() - start) / 60
    in_shards, waiting = count_items(options.out)
    problem = ""
    try:
        checked = check_items(options.out)
    except (AssertionError, UserError) as error:
        checked, problem = 0, str(error)
    new = in_shards + waiting - before
    is_right = not problem and checked == in_shards + waiting > 0 and ended in ("done", "time is up")
    report = {
        "tried": tried,
        "workers": workers,
        "ended": ended,
        "items": {"in_shards": in_shards, "waiting": waiting, "new": new, "checked": checked},
        "minutes": round(minutes, 2),
        "items_per_minute": round(new / minutes, 2),
        "megabytes": round(sum(path.stat().st_size for path in options.out.glob("*.tar")) / 1e6, 2),
        "problem": problem,
        "passed": is_right,
    }
    print(json.dumps(report))
    sys.exit(0 if is_right else 1)


if __name__ == "__main__":
    main()
