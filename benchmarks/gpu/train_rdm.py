"""Train a relighting model on pairs for as long as a time budget lasts, and carry it off in small files; prints JSON.

python benchmarks/gpu/train_rdm.py PAIRS --out RUN --carried OUT [--held-out PAIRS2] [--minutes 8] [--scale 1.0]
    [--device auto] [--tiny]

Stopped by the clock, RUN goes on from its last checkpoint when the same command is run again; on another machine RUN
is first made from the files in `--carried` where they are. PAIRS may grow in between, its address may not change.
While it trains, weights, averages and moments are carried; a finished run is carried as a model alone.
Exit status 1 where training failed or what was carried is not, bit by bit, what was trained.
"""

import argparse
import dataclasses
import json
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

import torch
from safetensors import safe_open

from illuminerf.diffusion.training_config import MonitoringConfig
from illuminerf.stages import train_relighting_model
from illuminerf.stages.train_relighting_model import Config, Phase
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.atomic import write_bytes
from illuminerf.workflow.checksums import seal_digest

sys.path.insert(0, str(Path(__file__).parents[2]))
from benchmarks.gpu.carried_folder import differences, pack, unpack  # noqa: E402

_STATE = "training*.safetensors"
"""Checkpoints of the run, which a finished model does not need."""
_MOST_FILES = 8
_MOST_BYTES = 16 * 2**20


def configured(options: argparse.Namespace) -> Config:
    """The stage's own defaults, with every phase stretched by `--scale`."""
    config = Config(device=options.device, checkpoint_seconds=options.checkpoint_seconds)
    if options.tiny:
        monitoring = MonitoringConfig(validation_pairs=1, final_pairs=1)
        phases = (Phase(2, 16, "products"), Phase(1, 16))
        return dataclasses.replace(config, phases=phases, batch_size=2, monitoring=monitoring)
    phases = tuple(
        dataclasses.replace(phase, num_steps=max(1, round(phase.num_steps * options.scale))) for phase in config.phases
    )
    return dataclasses.replace(config, phases=phases, batch_size=options.batch)


def train(pairs: Path, held_out: Path, config: Config, out: Path, seconds: float) -> str:
    """The stage in a process of its own, which is ended when time is up; how it ended."""
    process = multiprocessing.get_context("spawn").Process(
        target=train_relighting_model.run, args=(pairs, held_out, config, out)
    )
    process.start()
    process.join(seconds)
    if process.exitcode is None:
        process.terminate()
        process.join(20)
        if process.exitcode is None:
            process.kill()
            process.join()
        return "time is up"
    return "done" if process.exitcode == 0 else f"exit status {process.exitcode}"


def finished_steps(out: Path) -> int:
    """Steps of the last checkpoint."""
    checkpoint = out / "training.safetensors"
    if not checkpoint.is_file():
        return 0
    with safe_open(str(checkpoint), framework="pt") as stream:
        return int(json.loads((stream.metadata() or {}).get("illuminerf", "{}")).get("step", 0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", type=Path)
    parser.add_argument("--held-out", type=Path, help="pairs of other objects, for validation; default PAIRS")
    parser.add_argument("--out", type=Path, required=True, help="the run")
    parser.add_argument("--carried", type=Path, required=True, help="what is brought and taken away")
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the steps of every phase")
    parser.add_argument("--batch", type=int, default=Config().batch_size)
    parser.add_argument("--checkpoint-seconds", type=float, default=45.0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--tiny", action="store_true", help="three steps at 16 pixels")
    options = parser.parse_args()
    is_brought = not options.out.exists() and (options.carried / "index.json").is_file()
    if is_brought:
        unpack(options.carried, options.out)
        if (options.out / "DONE").exists():
            # pictures stayed behind: the folder is sealed for what has come
            write_bytes(options.out / "DONE", (seal_digest(options.out) + "\n").encode())
            print(json.dumps({"ended": "was done before", "model": str(options.out), "passed": True}))
            return
    config = configured(options)
    before, start = finished_steps(options.out), time.monotonic()
    ended = train(options.pairs, options.held_out or options.pairs, config, options.out, 60 * options.minutes)
    seconds = time.monotonic() - start
    left_out = _STATE if (options.out / "DONE").exists() else ""
    files = pack(options.out, options.carried, left_out=left_out)
    with tempfile.TemporaryDirectory() as temporary:
        unpack(options.carried, Path(temporary))
        different = differences(options.out, Path(temporary), left_out)
    largest = max(path.stat().st_size for path in files)
    steps = finished_steps(options.out)
    is_right = ended in ("done", "time is up") and not different and largest <= _MOST_BYTES and steps > 0
    report = {
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() and options.device != "cpu" else "cpu",
        "ended": ended,
        "resumed_from_carried_files": is_brought,
        "steps": {"before": before, "now": steps, "wanted": config.num_steps},
        "steps_per_second": round((steps - before) / seconds, 3),
        "seconds": round(seconds, 1),
        "scores": read_metrics(options.out).get("scores") if (options.out / "DONE").exists() else None,
        "carried": {"files": len(files), "largest_bytes": largest, "different": different},
        "too_many_files": len(files) > _MOST_FILES,
        "passed": is_right,
    }
    print(json.dumps(report))
    sys.exit(0 if is_right else 1)


if __name__ == "__main__":
    main()
