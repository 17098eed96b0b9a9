"""`ItemRenderer` on Blender's Cycles, the path tracer of the paper, in a process of its own.

Blender is an optional extra: its module `bpy` fits one version of Python per release, so that the program `blender`
or another Python may do the work instead. docs/renderers.md says how to install it and how far it is from Mitsuba.
"""

import contextlib
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from illuminerf.cues.blender_job import Rendering, read_rendering, write_job
from illuminerf.cues.item_renderer import RenderedItem, surface_of
from illuminerf.cues.materials import Material, Parts
from illuminerf.cues.renderer import CUE_NAMES, CUE_ROUGHNESS, CueSampling
from illuminerf.cues.shading import PATH_DEPTH, ShadedScene
from illuminerf.cues.texture_baking import baked
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.device import derived_seed
from illuminerf.workflow.errors import UserError

_WORKER = Path(__file__).with_name("blender_worker.py")
_INSTALL = (
    "pip install 'illuminerf[blender]' under Python 3.13 or 3.11 (each release of bpy fits one version of Python), or "
    "name a blender program or another Python that has bpy as the executable (docs/renderers.md)"
)
_SYSTEM_LIBRARIES = "apt install libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libxrender1 libsm6 libgl1 libgomp1"
_LAST_LINES = 8
_FREE_SPACE = "free some space where temporary files lie, or name a folder with more in TMPDIR"
_LESS_AT_ONCE = "run fewer workers at once, or on a machine with more memory"
_OTHER_DEVICE = "see that the graphics card works and is free, or render with --device cpu"
# What Blender says where the machine is short of something, in lower case, and what to do: no fault of the item.
_SHORTAGES = (
    (r"errno 28\b|no space left|disk full|errno 122\b|disk quota", _FREE_SPACE),
    (r"out of gpu memory|\b(cuda|optix|hip)[ _]?error|(cuda|optix)_error|failed to create (cuda|optix)|cuda device"
     r"|failed to (load|build) (cuda|optix) kernel|illegal address", _OTHER_DEVICE),
    (r"out of memory|cannot allocate memory|errno 12\b|memoryerror|bad_alloc|calloc returns null|malloc returns null",
     _LESS_AT_ONCE),
)  # fmt: skip
_TASK_SECONDS = "ILLUMINERF_TASK_SECONDS"
_SHARE_OF_TASK = 0.8


class BlenderFailed(UserError):
    """Blender is there, but gave no picture of this item: a reason to leave the item out, not to stop."""


@dataclass(frozen=True)
class BlenderItemRenderer:
    """`ItemRenderer` on Blender's Cycles: one process per item renders every target and cue."""

    samples_per_pixel: int = 512
    """Paths per pixel of the targets; 512 in the paper."""
    cue_sampling: CueSampling = field(default_factory=CueSampling)
    """Paths and bounces of the cues, the same choice as Mitsuba's; device cuda renders on a graphics card, all else on
    the processor."""
    executable: str = ""
    """A blender program, or a Python (its name begins with "python") that has the module bpy; empty: bpy of this
    Python, else the blender on the PATH."""
    denoises: bool = False
    """Let OpenImageDenoise work on every picture; it harms sharp reflections."""
    timeout_seconds: float = 1500.0
    """After which an item is given up; at most 0.8 of what ILLUMINERF_TASK_SECONDS, where it is set, allows a task, so
    that Blender is ended here before the task is."""
    bakes_properties: bool = True
    """Read base colour, roughness and metallic from textures moved onto vertices, as Mitsuba's renderings are by
    default; the pictures themselves keep their textures."""

    def __post_init__(self) -> None:
        if self.samples_per_pixel < 1:
            raise UserError("samples_per_pixel is too small", got=str(self.samples_per_pixel), wanted="1 or more")
        if not self.timeout_seconds > 0:
            raise UserError("timeout_seconds is too small", got=str(self.timeout_seconds), wanted="more than 0")

    def render(
        self,
        parts: Parts,
        camera: Cameras,
        lights: list[EnvironmentMap],
        seed: int,
        cue_mesh: TriangleMesh | None = None,
    ) -> RenderedItem:
        """Render what the first view of `camera` sees of `parts`, once per light.

        Raises:
            BlenderFailed: it failed or ran out of time; the message has its last lines.
            UserError: there is no Blender, or this machine is short of something that it needs.
        """
        renderings = self._renderings(len(lights), seed)
        if cue_mesh is None:
            images = self._pictures(parts, camera, lights, renderings)
        else:
            own = [rendering for rendering in renderings if rendering.material == "own"]
            others = [rendering for rendering in renderings if rendering.material != "own"]
            images = self._pictures(parts, camera, lights, own)
            images |= self._pictures([(cue_mesh, Material())], camera, lights, others)
        planes = {key: image.transpose(2, 0, 1) for key, image in images.items()}
        targets = [planes[f"target_{i}"][:3] for i in range(len(lights))]
        cues = [np.concatenate([planes[f"{cue}_{i}"][:3] for cue in CUE_NAMES]) for i in range(len(lights))]
        properties = baked(parts) if self.bakes_properties else parts
        scene = ShadedScene(properties, lights[0], self.cue_sampling.device)
        alpha = np.clip(images["target_0"][..., 3], 0, 1)
        return RenderedItem(np.stack(targets), np.stack(cues), alpha, *surface_of(scene, camera))

    def _pictures(
        self, parts: Parts, camera: Cameras, lights: list[EnvironmentMap], renderings: list[Rendering]
    ) -> dict[str, np.ndarray]:
        """What one Blender process renders, by name: [height, width, 4]."""
        with tempfile.TemporaryDirectory(prefix="illuminerf-blender-") as name:
            folder = Path(name)
            try:
                write_job(folder, parts, camera, lights, renderings, self.denoises, self.cue_sampling.device)
            except OSError as error:
                raise UserError("Blender's job cannot be written", got=str(error), fix=_FREE_SPACE) from error
            timeout = capped_timeout(self.timeout_seconds)
            run_blender(worker_command(self.executable, folder), folder / "log.txt", timeout)
            return {r.name: _picture(folder, r.name, camera) for r in renderings}

    def _renderings(self, num_lights: int, seed: int) -> list[Rendering]:
        cues, result = self.cue_sampling, []
        for light in range(num_lights):
            own = derived_seed(seed, "target", light)
            result.append(Rendering(f"target_{light}", "own", light, self.samples_per_pixel, PATH_DEPTH, own))
            stream = derived_seed(seed, "cues", light)
            diffuse = derived_seed(stream, "diffuse")
            result.append(
                Rendering(
                    f"{CUE_NAMES[0]}_{light}", "diffuse", light, cues.samples_per_pixel, cues.diffuse_depth, diffuse
                )
            )
            for name, roughness in zip(CUE_NAMES[1:], CUE_ROUGHNESS, strict=True):
                lobe = derived_seed(stream, "specular", roughness)
                depth = cues.specular_depth
                result.append(
                    Rendering(f"{name}_{light}", "glossy", light, cues.samples_per_pixel, depth, lobe, roughness)
                )
        return result


def worker_command(executable: str, folder: Path) -> list[str]:
    """What renders a job folder: see `BlenderItemRenderer.executable`.

    Raises:
        UserError: there is nothing that could.
    """
    program = executable
    if not program:
        program = sys.executable if importlib.util.find_spec("bpy") else shutil.which("blender") or ""
        if not program:
            raise UserError("Blender is not installed: no module bpy and no program blender", fix=_INSTALL)
    found = shutil.which(program)
    if found is None:
        raise UserError("the Blender executable does not exist or is no program", got=program, fix=_INSTALL)
    if Path(found).name.lower().startswith("python"):
        # -P: the modules beside the worker must not stand in for Blender's own of the same names
        return [found, "-P", str(_WORKER), str(folder)]
    options = ["--background", "--factory-startup", "--python-exit-code", "1", "--python", str(_WORKER)]
    return [found, *options, "--", str(folder)]


def capped_timeout(seconds: float) -> float:
    """`seconds`, or 0.8 of what ILLUMINERF_TASK_SECONDS allows, whichever is less."""
    text = os.environ.get(_TASK_SECONDS, "").strip()
    if not text:
        return seconds
    try:
        allowed = float(text)
    except ValueError:
        allowed = float("nan")
    if not allowed > 0:
        raise UserError(f"{_TASK_SECONDS} is no number of seconds", got=text, wanted="a number above 0")
    return min(seconds, _SHARE_OF_TASK * allowed)


def run_blender(command: list[str], log_file: Path, timeout_seconds: float) -> None:
    """Run a command to its end, what it says in a file: the blender program complains on stdout, bpy on stderr.

    Raises:
        BlenderFailed: it fails or runs out of time.
        UserError: it does not start, or this machine is short of something that it needs.
    """
    # the worker ends itself when this process is gone, even where it was killed and could not end the worker
    environment = {**os.environ, "ILLUMINERF_PARENT": str(os.getpid())}
    try:
        with log_file.open("wb") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
                env=environment,
            )  # fmt: skip
    except OSError as error:
        raise UserError("Blender does not start", got=str(error), fix=_INSTALL) from error
    try:
        status = process.wait(timeout_seconds)
    except subprocess.TimeoutExpired as error:
        raise BlenderFailed(
            f"Blender did not finish one item in {timeout_seconds:g} s",
            got=_last_lines(log_file),
            fix="use fewer samples or pixels, or a longer timeout_seconds",
        ) from error
    finally:
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # whatever it started goes with it
            process.wait()
    if status != 0:
        words = _last_lines(log_file)
        fix = _mendable(words) or _shortage(log_file)
        if status == -signal.SIGKILL:  # nobody here sent it: as a rule the system, out of memory
            fix = fix or _LESS_AT_ONCE
        kind = UserError if fix else BlenderFailed
        raise kind(f"Blender failed with status {status}", got=words, fix=fix)


def _mendable(words: str) -> str:
    """What to install where Blender lacks a part of itself, else ""."""
    if "No module named 'bpy'" in words:
        return _INSTALL
    if "No module named 'numpy'" in words:
        return "install numpy for Blender's own Python (Debian, Ubuntu: apt install python3-numpy)"
    if ".so" in words and ("cannot open shared object" in words or "shared libraries" in words):
        return f"install the system libraries that Blender needs (Debian, Ubuntu: {_SYSTEM_LIBRARIES})"
    return ""


def _shortage(log_file: Path) -> str:
    """What to do where the log tells of a full disk, too little memory or a broken graphics card, else ""."""
    text = log_file.read_text(errors="replace").lower()
    return next((fix for pattern, fix in _SHORTAGES if re.search(pattern, text)), "")


def _picture(folder: Path, name: str, camera: Cameras) -> np.ndarray:
    if not (folder / f"{name}.exr").is_file():  # Blender may leave with status 0 all the same
        log_file = folder / "log.txt"
        fix = _shortage(log_file)
        kind = UserError if fix else BlenderFailed
        raise kind(f"Blender ended without the picture {name}", got=_last_lines(log_file), fix=fix)
    return read_rendering(folder, name, camera)


def _last_lines(path: Path) -> str:
    lines = [line.strip() for line in path.read_text(errors="replace").splitlines() if line.strip()]
    return " | ".join(lines[-_LAST_LINES:]) or "not a word"
