"""Which of Mitsuba's back ends this machine can run."""

import ctypes
import ctypes.util
import functools
import importlib
import os
from pathlib import Path
from types import ModuleType

import torch

from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say

# With LLVM 14 to 16 the `principled` material aborts the process ("Cannot select: fminimum").
_OLDEST_LLVM = 19
_NEWEST_LLVM = 24
_OPTIX = "libnvoptix.so.1"
_chosen: list[str] = []


def find_llvm() -> tuple[str, int] | None:
    """The first libLLVM that loads and is new enough: (path or soname, major version), or None."""
    candidates = [os.environ.get("DRJIT_LIBLLVM_PATH", "")]
    for major in range(_NEWEST_LLVM, _OLDEST_LLVM - 1, -1):
        candidates += [f"libLLVM.so.{major}.1", f"libLLVM.so.{major}", f"libLLVM-{major}.so"]
        candidates += [f"/usr/lib/llvm-{major}/lib/libLLVM.so", f"/opt/homebrew/opt/llvm@{major}/lib/libLLVM.dylib"]
    candidates.append(ctypes.util.find_library("LLVM") or "")
    for candidate in filter(None, candidates):
        version = _llvm_version(candidate)
        if version is not None and version >= _OLDEST_LLVM:
            return candidate, version
    return None


def _llvm_version(library: str) -> int | None:
    if os.sep in library and not Path(library).exists():
        return None
    try:
        llvm = ctypes.CDLL(library)
        major = ctypes.c_uint()
        llvm.LLVMGetVersion(ctypes.byref(major), None, None)
    except (OSError, AttributeError):
        return None
    return int(major.value)


@functools.cache
def _gpu_traces_rays() -> bool:
    """Whether there is a GPU, and OptiX, which comes with NVIDIA's driver."""
    if not torch.cuda.is_available():
        return False
    try:
        ctypes.CDLL(_OPTIX)
    except OSError:
        return False
    return True


def choose_variant(device: str = "auto") -> str:
    """The Mitsuba variant for a device: cuda_ad_rgb for "cuda", and for "auto" where a GPU can trace rays; else
    llvm_ad_rgb or scalar_rgb.

    Raises:
        UserError: the device is not one of auto, cpu, cuda.
    """
    if device == "cuda" or (device == "auto" and _gpu_traces_rays()):
        return "cuda_ad_rgb"
    if device not in ("auto", "cpu"):
        raise UserError("no such device for the path tracer", got=device, wanted="auto, cpu or cuda")
    llvm = find_llvm()
    if llvm is None:
        return "scalar_rgb"
    os.environ["DRJIT_LIBLLVM_PATH"] = llvm[0]  # else Dr.Jit may pick up another toolchain's older one
    return "llvm_ad_rgb"


@functools.cache
def load_mitsuba(device: str = "auto") -> ModuleType:
    """Import Mitsuba with its variant set; says once which one where it is the slow one.

    Raises:
        UserError: Mitsuba is not installed, or CUDA is asked for and does not work.
    """
    try:
        mitsuba = importlib.import_module("mitsuba")
    except ImportError as error:
        raise UserError("the path tracer is not installed", fix="pip install mitsuba") from error
    variant = choose_variant(device)
    if _chosen and _chosen[0] != variant:
        raise UserError(
            "one process renders with one Mitsuba variant", got=variant, wanted=_chosen[0], fix="use one device"
        )
    if variant == "scalar_rgb":
        say(
            f"No libLLVM >= {_OLDEST_LLVM} found: cues are path traced with Mitsuba's scalar_rgb, 2 to 4 times slower "
            "(Debian, Ubuntu: apt install libllvm19)."
        )
    try:
        mitsuba.set_variant(variant)
        mitsuba.Float(0) + 1
    except (ImportError, RuntimeError) as error:
        raise UserError(
            f"Mitsuba's {variant} does not start", got=str(error).splitlines()[0], fix="render with --device cpu"
        ) from error
    threads = os.environ.get("ILLUMINERF_RENDER_THREADS", "")
    if threads.isdigit() and int(threads) > 0:  # several processes on one machine share its cores
        importlib.import_module("drjit").set_thread_count(int(threads))
    mitsuba.set_log_level(mitsuba.LogLevel.Error)  # it warns of every rounding of a sample count
    _chosen.append(variant)
    return mitsuba
