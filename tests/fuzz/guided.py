"""Spoilt inputs by coverage: what reaches a branch that nothing reached before is kept, and spoilt further.

libFuzzer does it, by way of atheris (optional). It chooses an input of the corpus, `reader.mutate` spoils it (or,
now and then, libFuzzer's own mutations do), and branches of Python code are counted while it is read. The corpus is a
folder, so that another run goes on from there; bounds and tallies are those of `sandbox`.
"""

import gc
import hashlib
import os
import random
import sys
import time
import types
from pathlib import Path
from typing import Any

from numba.core.dispatcher import Dispatcher

from illuminerf.workflow.errors import UserError
from tests.fuzz.readers import Reader
from tests.fuzz.sandbox import Escape, Tally, Task, Worker, inputs_of, watched

PACKAGES = ("illuminerf", "PIL", "trimesh", "tarfile")
"""Whose branches count; libraries in C are seen only by what Python does with their answers."""
_OWN_MUTATIONS = 0.25
"""Share of inputs that libFuzzer spoils itself: it knows numbers and strings that the code compares with."""
_ANEW = 0.3
"""Share of inputs that are made from good ones: most of a corpus is what readers refuse early, each in its own way."""
_LONGEST = 2**17
"""Bytes of an input."""
_FOR_EVER = 10**6
_QUIETLY = (f"-timeout={_FOR_EVER}", "-rss_limit_mb=0", "-reload=0", "-verbosity=0", f"-max_len={_LONGEST}")
"""Time and memory are watched by `sandbox`."""


def need_atheris() -> Any:
    """The package.

    Raises:
        UserError: it is not installed.
    """
    try:
        import atheris
    except ImportError as error:
        raise UserError(
            "the coverage-guided fuzzer needs the package atheris",
            got=str(error),
            fix="run 'pip install atheris' (Linux, or the extra 'fuzz'), or leave out --guided",
        ) from error
    return atheris


def warm_up(reader: Reader, folder: Path) -> None:
    """Read the good inputs, so that what is imported or compiled at the first use is there before forks are made."""
    for content in inputs_of(reader, folder):
        (folder / reader.file).write_bytes(content)
        reader.read(folder)


def instrument(packages: tuple[str, ...] = PACKAGES) -> int:
    """Make every function of `packages` that is loaded report its branches; returns how many there are.

    Functions that numba compiles are left as they are: it would compile the reports as well.
    """
    atheris = need_atheris()
    ours = [module for name, module in sys.modules.items() if _is_one_of(packages, name)]
    values = [value for module in ours for value in vars(module).values()]
    compiled = {id(value.py_func) for value in values if issubclass(type(value), Dispatcher)}
    functions = [
        value
        for value in gc.get_objects()
        if type(value) is types.FunctionType
        and _is_one_of(packages, value.__module__ or "")
        and id(value) not in compiled
    ]
    counted = {function.__code__: atheris.patch_code(function.__code__, True, True) for function in functions}
    for function in functions:
        function.__code__ = counted[function.__code__]
    return len(functions)


def _is_one_of(packages: tuple[str, ...], module: str) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def fuzz_guided(
    reader: Reader, folder: Path, first: int, count: int, seconds: float, corpus: Path, keep: Path | None = None
) -> tuple[Tally, list[Escape]]:
    """Try `count` inputs, in processes that may crash, until the time is over; `corpus` is read and added to.

    `first` sets the seed, and is the number of the first input.
    """
    corpus.mkdir(parents=True, exist_ok=True)
    for content in inputs_of(reader, folder):
        (corpus / hashlib.sha1(content).hexdigest()).write_bytes(content)
    task = Task(reader, folder, time.monotonic() + seconds, keep)
    at, end = first, first + count
    while at < end and time.monotonic() < task.ends:
        at = watched(task, at, end, lambda worker: _by_coverage(worker, corpus))
    return task.tally, task.escapes


def _by_coverage(worker: Worker, corpus: Path) -> None:
    """Of a process of its own: it ends with it."""
    atheris = need_atheris()
    known = {path.read_bytes() for path in corpus.iterdir()} | {b""}
    seen = 0

    def read(content: bytes) -> None:
        nonlocal seen
        if not worker.goes_on():
            os._exit(0)
        seen += 1  # libFuzzer begins with what it knows
        worker.read(content, counts=seen > len(known) or content not in known)

    def spoil(content: bytes, longest: int, seed: int) -> bytes:
        draw = random.Random(seed)
        if draw.random() < _OWN_MUTATIONS:
            return bytes(atheris.Mutate(content, longest))
        start = draw.choice(worker.good) if draw.random() < _ANEW else content
        return worker.task.reader.mutate(start, draw, draw.choice(worker.good))[:longest]

    options = [f"-seed={worker.at + 1}", f"-artifact_prefix={worker.task.folder.parent}/", *_QUIETLY]
    atheris.Setup(["fuzz", *options, str(corpus)], read, custom_mutator=spoil)
    atheris.Fuzz()
