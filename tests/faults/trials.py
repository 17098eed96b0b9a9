"""One fault at a time: disturb a stage or what it made, start it again, and say what came of it.

A trial ends well where the second start gives the same bytes as an undisturbed run, or where the damage is named in a
UserError. All work is done in forks of this process, which has the libraries loaded and must not have used their
threads.
"""

import hashlib
import random
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from illuminerf.cues import mitsuba_variant
from tests.faults.injection import Fault, FaultKind, Outcome, finish, in_child, start
from tests.faults.tiny_stages import STAGES, Stage, consumers, write_inputs

Damage = Literal["flip", "truncate", "remove"]
TrialKind = Literal[
    "kill", "EIO", "ENOSPC", "size", "later", "flip", "truncate", "remove", "flip in unfinished", "two processes"
]
TRIAL_KINDS: tuple[TrialKind, ...] = TrialKind.__args__  # type: ignore[attr-defined]
_DIFFERS_BETWEEN_RUNS = ("provenance.json", "checksums.json", ".lock", ".written")


@dataclass(frozen=True)
class Trial:
    """One fault to try; `seed` says where it strikes."""

    stage: str
    kind: TrialKind
    seed: int


@dataclass(frozen=True)
class Verdict:
    """What came of a trial."""

    verdict: Literal["same", "named", "lost", "silent", "unclear"]
    """same: the same bytes in the end; named: a UserError says what is damaged; lost: started again, it does not
    finish; silent: it finishes with other bytes; unclear: an error that is no UserError, or a hang."""
    detail: str = ""


def contents(folder: Path) -> dict[str, str]:
    """Checksums by name of all files that equal runs have in common."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in _DIFFERS_BETWEEN_RUNS
    }


class World:
    """Undisturbed runs of stages, to compare with.

    Args:
        folder: an empty one.
        names: the stages; those that they need are run too.
    """

    def __init__(self, folder: Path, names: tuple[str, ...] = tuple(STAGES)) -> None:
        self.folder, self.made, self.operations, self.seconds = folder, folder / "made", {}, {}
        write_inputs(self.made)
        for stage in _needed(names):
            outcome = in_child(lambda stage=stage: self._run(stage, self.made / stage.name), self.made / stage.name)
            if outcome.status != "done":
                raise RuntimeError(f"{stage.name} does not run undisturbed: {outcome.message}")
            self.operations[stage.name], self.seconds[stage.name] = outcome.operations, outcome.seconds
        self.expected = {stage.name: contents(self.made / stage.name) for stage in _needed(names)}

    def _run(self, stage: Stage, out: Path, replaced: dict[str, Path] | None = None) -> object:
        torch.set_num_threads(1)  # always in a fork, which has no other threads
        mitsuba_variant.find_llvm = lambda: None  # and would compile kernels each time
        found = {name: self.made / name for name in stage.inputs} | (replaced or {})
        return stage.make(*(found[name] for name in stage.inputs), out)

    def attempt(self, trial: Trial) -> Verdict:
        """Do a trial in a folder of its own, which is removed."""
        place = self.folder / "trial"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        draw = random.Random(f"{trial.stage} {trial.kind} {trial.seed}")
        try:
            match trial.kind:
                case "flip" | "truncate" | "remove":
                    return self._damaged(STAGES[trial.stage], trial.kind, draw, place)
                case "flip in unfinished":
                    return self._damaged_unfinished(STAGES[trial.stage], draw, place / "out")
                case "two processes":
                    return self._two_processes(STAGES[trial.stage], draw, place / "out")
                case _:
                    return self._disturbed(STAGES[trial.stage], self._fault(trial, draw), place / "out")
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def _fault(self, trial: Trial, draw: random.Random) -> Fault:
        kind: FaultKind = trial.kind  # type: ignore[assignment]
        if kind == "later":
            return Fault(kind, round(1000 * draw.uniform(0.0, 1.1 * self.seconds[trial.stage])))
        if kind == "size":
            sizes = [path.stat().st_size for path in (self.made / trial.stage).rglob("*") if path.is_file()]
            return Fault(kind, draw.randrange(max(sizes)) if draw.random() < 0.3 else draw.choice(sizes) // 2)
        return Fault(kind, draw.randint(1, self.operations[trial.stage]))

    def _disturbed(self, stage: Stage, fault: Fault, out: Path) -> Verdict:
        first = in_child(lambda: self._run(stage, out), out, fault)
        if first.status in ("escaped", "hung"):
            return Verdict("unclear", f"{fault}: {first.status}: {first.message}")
        if first.status == "done" and self._differs(stage, out):
            return Verdict("silent", f"{fault}: {self._differs(stage, out)}")
        return self._started_again(stage, out, str(fault))

    def _started_again(self, stage: Stage, out: Path, after: str, may_be_named: bool = False) -> Verdict:
        again = in_child(lambda: self._run(stage, out), out)
        if again.status == "user error" and may_be_named:
            return Verdict("named", again.message)
        if again.status != "done":
            kind: Literal["lost", "unclear"] = "lost" if again.status == "user error" else "unclear"
            return Verdict(kind, f"{after}: {again.status}: {again.message}")
        differs = self._differs(stage, out)
        return Verdict("silent", f"{after}: {differs}") if differs else Verdict("same")

    def _differs(self, stage: Stage, out: Path) -> str:
        """The first file that is not as in the undisturbed run; "" where there is none."""
        found, expected = contents(out), self.expected[stage.name]
        names = sorted({*found, *expected}, key=lambda name: (name == "DONE", name))
        return next((name for name in names if found.get(name) != expected.get(name)), "")

    def _damaged(self, stage: Stage, damage: Damage, draw: random.Random, place: Path) -> Verdict:
        """Spoil a finished folder; then read it with every stage that does, and make it again."""
        out = place / "out"
        shutil.copytree(self.made / stage.name, out)
        after = f"{damage} {spoil(out, damage, draw)}"
        worst = Verdict("same")
        for consumer in consumers(stage.name):
            if consumer.name not in self.expected:
                continue
            outcome = in_child(lambda consumer=consumer: self._run(consumer, place / "read", {stage.name: out}), place)
            found = self._judged_reading(consumer, outcome, place / "read", after)
            worst = max((worst, found), key=lambda verdict: _BADNESS.index(verdict.verdict))
            shutil.rmtree(place / "read", ignore_errors=True)
        own = self._started_again(stage, out, after, may_be_named=True)
        return max((worst, own), key=lambda verdict: _BADNESS.index(verdict.verdict))

    def _judged_reading(self, consumer: Stage, outcome: Outcome, out: Path, after: str) -> Verdict:
        if outcome.status == "user error":
            return Verdict("named", outcome.message)
        if outcome.status != "done":
            return Verdict("unclear", f"{after}, {consumer.name}: {outcome.message}")
        differs = _of_content(self._differs(consumer, out))
        return Verdict("silent", f"{after}, read by {consumer.name}: {differs}") if differs else Verdict("same")

    def _damaged_unfinished(self, stage: Stage, draw: random.Random, out: Path) -> Verdict:
        """Kill a run late, flip a bit of what it leaves, and go on."""
        count = self.operations[stage.name]
        fault = Fault("kill", draw.randint(count // 2, count))
        in_child(lambda: self._run(stage, out), out, fault)
        after = f"flip {spoil(out, 'flip', draw, grows=False)} after {fault}"
        return self._started_again(stage, out, after, may_be_named=True)

    def _two_processes(self, stage: Stage, draw: random.Random, out: Path) -> Verdict:
        """Start twice at about the same time."""
        first = start(lambda: self._run(stage, out), out)
        delay = draw.uniform(0, self.seconds[stage.name])
        second = start(lambda: (time.sleep(delay), self._run(stage, out)), out)
        for outcome in (finish(first), finish(second)):
            if outcome.status not in ("done", "user error"):
                return Verdict("unclear", f"two processes: {outcome.message}")
        return self._started_again(stage, out, "two processes")


_BADNESS = ("same", "named", "unclear", "lost", "silent")


def _of_content(name: str) -> str:
    # a reader of spoilt input that finishes records another fingerprint of it, and so is told from the others
    return "" if name in ("inputs.json", "DONE") else name


def _needed(names: tuple[str, ...]) -> Iterator[Stage]:
    """The stages of these names and all that they need, in order."""
    wanted = set(names)
    for stage in reversed(STAGES.values()):
        wanted |= set(stage.inputs) if stage.name in wanted else set()
    return (stage for stage in STAGES.values() if stage.name in wanted)


def spoil(folder: Path, damage: Damage, draw: random.Random, grows: bool = True) -> str:
    """Flip a bit of, cut off or remove one file; its name and where.

    Args:
        folder: of the file.
        damage: what happens to it.
        draw: chooses.
        grows: whether it may be a log that grows line by line and that nothing is computed from.
    """
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stat().st_size > 0]
    files = [path for path in files if (grows or path.suffix != ".jsonl") and path.name not in (".written", ".lock")]
    if not files:
        return "nothing"
    path = draw.choice(files)
    content, where = bytearray(path.read_bytes()), draw.randrange(path.stat().st_size)
    match damage:
        case "flip":
            content[where] ^= 1 << draw.randrange(8)
            path.write_bytes(content)
        case "truncate":
            path.write_bytes(content[:where])
        case "remove":
            path.unlink()
    return f"{path.relative_to(folder)} at {where}"


def plan(num_faults: int, names: tuple[str, ...], seed: int) -> list[Trial]:
    """Faults spread over stages and kinds; kills and failing operations come most often."""
    kinds: list[TrialKind] = ["kill"] * 5 + ["EIO"] * 3 + ["ENOSPC"] * 3 + ["later"] * 2 + ["size"] * 2
    kinds += ["flip"] * 4 + ["truncate", "remove", "flip in unfinished", "flip in unfinished", "two processes"]
    draw = random.Random(seed)
    trials: list[Trial] = []
    while len(trials) < num_faults:
        whole = [Trial(name, kind, draw.randrange(10**6)) for kind in kinds for name in names]
        draw.shuffle(whole)
        trials += whole
    return trials[:num_faults]
