"""Faults by the hundred: kills, full disks, failing reads and writes, damaged files, two processes on one folder.

    python benchmarks/faults.py --faults 500 --out faults.json

For each stage of the method on a tiny capture. A fault is lost where the stage, started again, neither ends with the
bytes of an undisturbed run nor says in one line what is damaged. Prints JSON; `lost`, `silent` and `unclear` must be 0.
"""

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.faults.tiny_stages import STAGES
from tests.faults.trials import Trial, Verdict, World, plan


def summary(results: list[tuple[Trial, Verdict]], seconds: float) -> dict[str, Any]:
    """Counts, and every trial that did not end well."""
    by_stage: dict[str, Counter[str]] = {}
    by_kind: dict[str, Counter[str]] = {}
    for trial, verdict in results:
        by_stage.setdefault(trial.stage, Counter())[verdict.verdict] += 1
        by_kind.setdefault(trial.kind, Counter())[verdict.verdict] += 1
    verdicts = Counter(verdict.verdict for _, verdict in results)
    return {
        "faults": len(results),
        "same_bytes": verdicts["same"],
        "damage_named": verdicts["named"],
        "lost": verdicts["lost"],
        "silent": verdicts["silent"],
        "unclear": verdicts["unclear"],
        "by_kind": {name: dict(counts) for name, counts in sorted(by_kind.items())},
        "by_stage": {name: dict(counts) for name, counts in sorted(by_stage.items())},
        "seconds": round(seconds, 1),
        "failures": [
            {
                "stage": trial.stage,
                "kind": trial.kind,
                "seed": trial.seed,
                "what": verdict.verdict,
                "why": verdict.detail,
            }
            for trial, verdict in results
            if verdict.verdict in ("lost", "silent", "unclear")
        ],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=500)
    parser.add_argument("--stages", nargs="+", default=list(STAGES), choices=list(STAGES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after this long")
    parser.add_argument("--out", type=Path, help="also write the JSON here, after every fault")
    options = parser.parse_args()
    began = time.monotonic()
    results: list[tuple[Trial, Verdict]] = []
    with tempfile.TemporaryDirectory(prefix="illuminerf_faults_") as folder:
        world = World(Path(folder), tuple(options.stages))
        for trial in plan(options.faults, tuple(options.stages), options.seed):
            if time.monotonic() - began > 60 * options.minutes:
                break
            results.append((trial, world.attempt(trial)))
            if options.out:
                options.out.write_text(json.dumps(summary(results, time.monotonic() - began), indent=1))
    print(json.dumps(summary(results, time.monotonic() - began), indent=1))


if __name__ == "__main__":
    main()
