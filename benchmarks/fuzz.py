"""Spoilt inputs by the hundred thousand, for every reader of files.

    python benchmarks/fuzz.py --minutes 30 --out fuzz.json
    python benchmarks/fuzz.py --readers glb --first 0 --count 1000

Prints JSON: inputs tried, and every one that gave neither a result nor a UserError, took too long or too much memory.
An input is known by its reader and seed.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.fuzz.readers import READERS
from tests.fuzz.sandbox import GIGABYTES, SECONDS, Escape, Tally, fuzz

_MEMORY = "/dev/shm"


def summary(tallies: dict[str, Tally], escapes: list[Escape], seconds: float) -> dict[str, Any]:
    """Counts by reader; of escapes that look alike only the first."""
    alike: dict[tuple[str, ...], dict[str, Any]] = {}
    for escape in escapes:
        entry = alike.setdefault(
            (escape.reader, escape.kind, escape.where.split(": ")[0]), asdict(escape) | {"times": 0}
        )
        entry["times"] += 1
    return {
        "inputs": sum(tally.tried for tally in tallies.values()),
        "escapes": len(escapes),
        "bounds": {"seconds": SECONDS, "gigabytes": GIGABYTES},
        "readers": {name: asdict(tally) for name, tally in tallies.items()},
        "first_of_each_escape": list(alike.values()),
        "seconds": round(seconds, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readers", nargs="+", default=list(READERS), choices=list(READERS))
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--count", type=int, default=10**6, help="seeds of each reader")
    parser.add_argument("--minutes", type=float, default=10.0, help="for all readers together, shared evenly")
    parser.add_argument("--out", type=Path, help="also write the JSON here, after every reader")
    options = parser.parse_args()
    began = time.monotonic()
    tallies: dict[str, Tally] = {}
    escapes: list[Escape] = []
    with tempfile.TemporaryDirectory(
        prefix="illuminerf_fuzz_", dir=_MEMORY if Path(_MEMORY).is_dir() else None
    ) as folder:
        for done, name in enumerate(options.readers):
            left = 60 * options.minutes - (time.monotonic() - began)
            share = left / (len(options.readers) - done)
            tallies[name], found = fuzz(READERS[name], Path(folder) / "input", options.first, options.count, share)
            escapes += found
            if options.out:
                options.out.write_text(json.dumps(summary(tallies, escapes, time.monotonic() - began), indent=1))
    print(json.dumps(summary(tallies, escapes, time.monotonic() - began), indent=1))


if __name__ == "__main__":
    main()
