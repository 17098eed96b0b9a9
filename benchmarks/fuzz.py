"""Spoilt inputs by the hundred thousand, for every reader of files.

    python benchmarks/fuzz.py --minutes 60 --out fuzz.json
    python benchmarks/fuzz.py --guided --minutes 60 --out fuzz_guided.json
    python benchmarks/fuzz.py --readers glb --first 0 --count 1000
    python benchmarks/fuzz.py --replay runs/fuzz/escapes/glb/*

Prints JSON: inputs tried, and every one that gave neither a result nor a UserError, took too long or too much memory.
An input is known by its reader and seed; each that escapes is also kept as a file, in a folder named for its reader.
Readers take turns, in rounds of equal counts. --guided spoils what reached code that nothing reached before (needs
atheris), and keeps that in a corpus from which the next run goes on.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch

from illuminerf.workflow.errors import UserError
from tests.fuzz.guided import fuzz_guided, instrument, need_atheris, warm_up
from tests.fuzz.readers import READERS, Reader
from tests.fuzz.sandbox import GIGABYTES, SECONDS, Escape, Tally, fuzz, replay

_MEMORY = "/dev/shm"
_FIRST_ROUND, _LARGEST_ROUND = 64, 4096
"""Inputs of each reader: a short run gives every reader its share, a long one starts few processes."""
Turn = Callable[[Reader, int, int, float], tuple[Tally, list[Escape]]]
"""Of a reader, the first input, how many, and seconds."""


def summary(tallies: dict[str, Tally], escapes: list[Escape], seconds: float, is_guided: bool) -> dict[str, Any]:
    """Counts by reader; of escapes that look alike only the first."""
    alike: dict[tuple[str, ...], dict[str, Any]] = {}
    for escape in escapes:
        entry = alike.setdefault(
            (escape.reader, escape.kind, escape.where.split(": ")[0]), asdict(escape) | {"times": 0}
        )
        entry["times"] += 1
    rates = {name: round(tally.tried / max(tally.seconds, 1e-3)) for name, tally in tallies.items()}
    return {
        "guided": is_guided,
        "inputs": sum(tally.tried for tally in tallies.values()),
        "escapes": len(escapes),
        "bounds": {"seconds": SECONDS, "gigabytes": GIGABYTES},
        "readers": {name: asdict(tally) | {"per_second": rates[name]} for name, tally in tallies.items()},
        "first_of_each_escape": list(alike.values()),
        "seconds_computed": round(sum(tally.seconds for tally in tallies.values()), 1),
        "seconds": round(seconds, 1),
    }


def rounds(turn: Turn, names: list[str], first: int, count: int, ends: float) -> Iterator[tuple[str, Tally, Any]]:
    """Give each reader its turn, round by round, until each has had `count` inputs or the time is over."""
    done, size = 0, _FIRST_ROUND
    while (size := min(size, count - done)) > 0:
        began = time.monotonic()
        for name in names:
            yield name, *turn(READERS[name], first + done, size, ends - time.monotonic())
        done += size
        took, left = max(time.monotonic() - began, 1e-3), ends - time.monotonic()
        fits = min(0.9 * size * left / took, _LARGEST_ROUND)  # so that the last round is a whole one
        size = min(2 * size, int(fits))


def replayed(files: list[Path], folder: Path) -> int:
    """Read kept inputs again, and print what becomes of each; how many escape."""
    num_escaped = 0
    for file in files:
        if file.parent.name not in READERS:
            raise UserError(f"{file} does not lie in a reader's folder", wanted=", ".join(READERS))
        escapes = replay(READERS[file.parent.name], folder, file.read_bytes())
        num_escaped += bool(escapes)
        print(json.dumps({"file": str(file), "escapes": [asdict(escape) for escape in escapes]}))
    return num_escaped


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readers", nargs="+", default=list(READERS), choices=list(READERS))
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--count", type=int, default=10**6, help="inputs of each reader")
    parser.add_argument("--minutes", type=float, default=10.0, help="for all readers together")
    parser.add_argument("--guided", action="store_true", help="by coverage, with atheris")
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"), help="folder of the corpus and of escapes")
    parser.add_argument("--replay", nargs="+", type=Path, metavar="FILE", help="read kept inputs again")
    parser.add_argument("--out", type=Path, help="also write the JSON here, after every round")
    return parser.parse_args()


def _turn(options: argparse.Namespace, folder: Path) -> Turn:
    escapes = options.keep / "escapes"
    if not options.guided:
        return lambda *given: fuzz(given[0], folder, *given[1:], keep=escapes)
    print(f"{instrument()} functions report their branches", file=sys.stderr)
    corpus = options.keep / "corpus"
    return lambda *given: fuzz_guided(given[0], folder, *given[1:], corpus=corpus / given[0].name, keep=escapes)


def main() -> int:
    options = _options()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(
        prefix="illuminerf_fuzz_", dir=_MEMORY if Path(_MEMORY).is_dir() else None
    ) as scratch:
        folder = Path(scratch) / "input"
        if options.replay:
            return int(replayed(options.replay, folder) > 0)
        if options.guided:
            need_atheris()
        for name in options.readers:
            warm_up(READERS[name], folder)
        turn = _turn(options, folder)
        began = time.monotonic()
        tallies = {name: Tally() for name in options.readers}
        escapes: list[Escape] = []
        for name, tally, found in rounds(
            turn, options.readers, options.first, options.count, began + 60 * options.minutes
        ):
            tallies[name].add(tally)
            escapes += found
            if options.out and name == options.readers[-1]:
                report = summary(tallies, escapes, time.monotonic() - began, options.guided)
                options.out.write_text(json.dumps(report, indent=1))
        print(json.dumps(summary(tallies, escapes, time.monotonic() - began, options.guided), indent=1))
    return int(bool(escapes))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(str(error))
