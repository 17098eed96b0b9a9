"""Triton kernels in processes of their own: whether they are interpreted is settled when Triton is imported."""

import importlib.util
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import load_file
from torch import Tensor

_ROOT = Path(__file__).parents[2]
needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="there is no triton (pip install triton; Linux only)"
)


def interpreted(script: str, folder: Path) -> dict[str, dict[str, Tensor]]:
    """What a script beside this file answers by Triton's interpreter, by case and name."""
    out = folder / "answers.safetensors"
    environment = os.environ | {
        "TRITON_INTERPRET": "1", "PYTHONPATH": f"{_ROOT / 'src'}:{_ROOT}", "OMP_NUM_THREADS": "1"
    }  # fmt: skip
    command = [sys.executable, str(_ROOT / "tests" / "fields" / script), str(out)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    cases: dict[str, dict[str, Tensor]] = {}
    for key, value in load_file(out).items():
        case, name = key.split("/")
        cases.setdefault(case, {})[name] = value
    return cases


def check_compiling(program: str, state: str, folder: Path) -> None:
    """A program that compiles kernels and then prints "compiled" does so where its first argument is "good"; where it
    is "spoilt" a tile is no power of two, and it does not.
    """
    from triton.compiler import ASTSource

    if "constexprs" not in inspect.signature(ASTSource).parameters:
        pytest.skip("this triton compiles by another interface")
    environment = os.environ | {"PYTHONPATH": str(_ROOT / "src"), "TRITON_CACHE_DIR": str(folder)}
    environment.pop("TRITON_INTERPRET", None)
    (folder / "compile_all.py").write_text(program)  # triton reads the source of kernels from files
    command = [sys.executable, str(folder / "compile_all.py"), state]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert ("compiled" in done.stdout) == (state == "good"), done.stderr[-3000:]
    assert state == "good" or "power of 2" in done.stderr
