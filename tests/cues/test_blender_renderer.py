"""The Blender renderer: its job files and its errors without Blender, its pictures beside Mitsuba's with it.

Blender is found through ILLUMINERF_BLENDER (a blender program, or a Python that has bpy) or as bpy of this Python.
"""

import errno
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from illuminerf.cues import blender_renderer
from illuminerf.cues.blender_job import Rendering, read_rendering, write_job
from illuminerf.cues.blender_renderer import BlenderFailed, BlenderItemRenderer, capped_timeout, worker_command
from illuminerf.cues.item_renderer import MitsubaItemRenderer, RenderedItem
from illuminerf.cues.materials import Material, Parts
from illuminerf.cues.renderer import CUE_NAMES, CueSampling
from illuminerf.evaluation.metrics import psnr
from illuminerf.scene.cameras import Cameras, look_at, turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_rgb_exr, srgb_from_linear, write_exr
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.workflow.errors import UserError

BLENDER = os.environ.get("ILLUMINERF_BLENDER", "")
needs_blender = pytest.mark.skipif(
    not BLENDER and importlib.util.find_spec("bpy") is None,
    reason="no Blender: set ILLUMINERF_BLENDER to a blender program or a Python that has bpy (docs/renderers.md)",
)
CAMERA = turntable_cameras(1, 3.2, 0.75, 64, 64)
SMALL: Cameras = turntable_cameras(1, 3.2, 0.75, 8, 6)
WHITE = EnvironmentMap(np.ones((16, 32, 3), np.float32))
FEW = CueSampling(samples_per_pixel=1)


def lamps(height: int) -> EnvironmentMap:
    """A soft white lamp and a smaller warm one in a grey room."""
    directions = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32)).directions()
    radiance = np.full(directions.shape, 0.3)
    for towards, cosine, color in (((0.7, 0.4, 0.6), 0.92, (6.0, 6.2, 6.6)), ((0.5, -0.8, 0.3), 0.96, (5.0, 3.9, 2.6))):
        along = directions @ (np.array(towards) / np.linalg.norm(towards))
        radiance += np.clip((along - cosine) / 0.03, 0, 1)[..., None] * np.array(color)
    return EnvironmentMap(radiance.astype(np.float32))


def checkered_sphere(metallic: float) -> Parts:
    """A sphere of longitudes and latitudes with a checkered texture."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, 65), np.linspace(-np.pi, np.pi, 129), indexing="ij")
    ring = np.sin(polar)
    vertices = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.cos(polar)], -1)
    uv = np.stack([azimuth / (2 * np.pi) + 0.5, 1 - polar / np.pi], -1)
    index = np.arange(65 * 129).reshape(65, 129)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    lower = np.stack([a[:-1], b[:-1], c[:-1]], -1)  # but at the south pole, where they have no area
    upper = np.stack([a[1:], c[1:], d[1:]], -1)  # but at the north pole
    faces = np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)]).astype(np.int32)
    row, column = np.indices((64, 128))
    is_red = ((row // 8 + column // 8) % 2)[..., None] == 1
    color = np.where(is_red, [0.8, 0.2, 0.1], [0.1, 0.3, 0.7]).astype(np.float32)
    roughness = np.where(is_red[..., 0], 0.3, 0.5).astype(np.float32)
    flat = vertices.reshape(-1, 3).astype(np.float32)
    return [(TriangleMesh(flat, faces, flat), Material(color, roughness, metallic, uv.reshape(-1, 2)))]


def corner() -> Parts:
    """Three squares that meet in a corner which is open towards (1, 1, 1)."""
    axes = np.eye(3)
    squares = [[0 * axes[i], axes[i - 2], axes[i - 2] + axes[i - 1], axes[i - 1]] for i in range(3)]
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(3)])
    vertices = np.array(squares, np.float32).reshape(-1, 3) - np.float32(0.4)
    return [(TriangleMesh(vertices, faces.astype(np.int32), np.repeat(axes, 4, 0).astype(np.float32)), Material())]


def layers(item: RenderedItem) -> dict[str, np.ndarray]:
    """Target and cues of the first light, [3, height, width] by name."""
    cues = {name: item.cues[0, 3 * i : 3 * i + 3] for i, name in enumerate(CUE_NAMES)}
    return {"target": item.targets[0], **cues}


def differences(item: RenderedItem, reference: RenderedItem) -> dict[str, tuple[float, float]]:
    """Relative difference of mean radiance and PSNR in sRGB, by layer."""
    coded = lambda image: srgb_from_linear(np.clip(image, 0, 1)).transpose(1, 2, 0)  # noqa: E731
    wanted = layers(reference)
    return {
        name: (float(abs(image.mean() / wanted[name].mean() - 1)), psnr(coded(image), coded(wanted[name])))
        for name, image in layers(item).items()
    }


def program(folder: Path, body: str) -> str:
    """A stand-in for the blender program: Python code that sees the job as `folder`."""
    path = folder / "blender"
    path.write_text(f"#!{sys.executable}\nimport sys\nfrom pathlib import Path\nfolder = Path(sys.argv[-1])\n{body}\n")
    path.chmod(0o755)
    return str(path)


# Without Blender


def test_job_holds_what_was_asked_for(tmp_path: Path) -> None:
    ball = sphere_mesh(1)
    colors = np.random.default_rng(0).random((len(ball.vertices), 3)).astype(np.float32)
    parts = [*checkered_sphere(0.25), (ball, Material(colors)), (ball, Material((0.1, 0.2, 0.3), 0.4, 1.0))]
    parts.append((ball, Material(metallic=0.3)))
    renderings = [
        Rendering("target_0", "own", 0, 7, 6, 5),
        Rendering("ggx_013_1", "glossy", 1, 9, 2, 2**40 + 1, 0.13),
    ]
    light = lamps(8)
    write_job(tmp_path, parts, SMALL, [WHITE, light], renderings, device="cpu")
    with np.load(tmp_path / "meshes.npz", allow_pickle=False) as file:
        arrays = dict(file)
    np.testing.assert_array_equal(arrays["vertices_0"], parts[0][0].vertices)
    np.testing.assert_array_equal(arrays["normals_1"], ball.vertex_normals)
    np.testing.assert_array_equal(arrays["faces_2"], ball.faces)
    np.testing.assert_array_equal(arrays["base_color_1"], colors)
    assert "uv_0" in arrays and "uv_1" not in arrays and "base_color_2" not in arrays
    np.testing.assert_array_equal(read_rgb_exr(tmp_path / "texture_0.exr"), parts[0][1].base_color)
    surface = read_rgb_exr(tmp_path / "surface_0.exr")
    np.testing.assert_array_equal(surface[..., 0], parts[0][1].roughness)
    assert (surface[..., 1] == 0.25).all()
    np.testing.assert_array_equal(read_rgb_exr(tmp_path / "light_1.exr"), light.linear_rgb)
    job = json.loads((tmp_path / "job.json").read_text())
    assert [material["kind"] for material in job["materials"]] == ["textured", "per_vertex", "constant", "mix"]
    assert job["materials"][2]["metallic"] == 1 and job["num_lights"] == 2 and job["device"] == "cpu"
    first, second = job["renderings"]
    assert (first["bounces"], second["bounces"]) == (4, 0) and first["samples"] == 7
    assert second["roughness"] == 0.13 and 0 <= second["seed"] < 2**31 and first["seed"] == 5


def test_pictures_are_read_back(tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((8, 6, 4)).astype(np.float32)
    write_exr(tmp_path / "a.exr", {name: image[..., i] for i, name in enumerate("RGBA")}, half=False)
    np.testing.assert_array_equal(read_rendering(tmp_path, "a", SMALL), image)
    with pytest.raises(UserError, match="another size"):
        read_rendering(tmp_path, "a", CAMERA)
    write_exr(tmp_path / "b.exr", {"Y": image[..., 0]})
    with pytest.raises(UserError, match="without colour"):
        read_rendering(tmp_path, "b", SMALL)


def test_layers_come_back_in_their_places(tmp_path: Path) -> None:
    """A stand-in for Blender paints each picture in a colour of its own."""
    executable = program(
        tmp_path,
        """
import json, numpy as np, OpenEXR
for i, one in enumerate(json.loads((folder / "job.json").read_text())["renderings"]):
    values = {c: np.full((8, 6), i + k / 4, np.float32) for k, c in enumerate("RGB")}
    alpha = {"A": np.full((8, 6), 0.5, np.float32)}
    OpenEXR.File({}, {**values, **alpha}).write(str(folder / f"{one['name']}.exr"))
""",
    )
    item = BlenderItemRenderer(1, FEW, executable).render([(sphere_mesh(1), Material())], SMALL, [WHITE, WHITE], 0)
    assert item.targets.shape == (2, 3, 8, 6) and item.cues.shape == (2, 12, 8, 6) and item.targets.dtype == np.float32
    np.testing.assert_array_equal(item.targets[:, :, 0, 0], [[0, 0.25, 0.5], [5, 5.25, 5.5]])
    np.testing.assert_array_equal(item.cues[1, ::3, 0, 0], [6, 7, 8, 9])
    assert (item.alpha == 0.5).all()
    assert item.base_color[0, 4, 3] == pytest.approx(0.8, abs=1e-3)  # from Mitsuba


def test_absent_blender_is_explained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(blender_renderer.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"illuminerf\[blender\]"):
        worker_command("", tmp_path)
    with pytest.raises(UserError, match="does not exist"):
        worker_command(str(tmp_path / "nowhere"), tmp_path)
    executable = program(tmp_path, "")
    assert worker_command("", tmp_path)[0] == executable
    assert worker_command("", tmp_path)[-2:] == ["--", str(tmp_path)]
    assert worker_command(sys.executable, tmp_path)[1] == "-P"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("sys.stderr.write('out of memory\\n'); sys.exit(3)", "status 3; got out of memory"),
        ("sys.exit(\"ModuleNotFoundError: No module named 'bpy'\")", r"illuminerf\[blender\]"),
        ("sys.exit('ImportError: libSM.so.6: cannot open shared object file')", "apt install"),
        ("print('Error: Python: line 1'); sys.exit(1)", "status 1; got Error: Python: line 1"),
        ("sys.stderr.write('lost interest\\n')", "without the picture target_0; got lost interest"),
    ],
)
def test_failing_blender_is_explained(tmp_path: Path, body: str, message: str) -> None:
    renderer = BlenderItemRenderer(1, FEW, program(tmp_path, body))
    with pytest.raises(UserError, match=message):
        renderer.render([(sphere_mesh(1), Material())], SMALL, [WHITE], 0)


def test_hanging_blender_is_ended_with_its_children(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    body = f"""
import subprocess, time
child = subprocess.Popen(["sleep", "60"])
Path({str(pid_file)!r}).write_text(str(child.pid))
sys.stderr.write("thinking\\n")
sys.stderr.flush()
time.sleep(60)
"""
    renderer = BlenderItemRenderer(1, FEW, program(tmp_path, body), timeout_seconds=2.0)
    start = time.monotonic()
    with pytest.raises(UserError, match="did not finish one item in 2 s; got thinking"):
        renderer.render([(sphere_mesh(1), Material())], SMALL, [WHITE], 0)
    assert time.monotonic() - start < 20
    deadline = time.monotonic() + 5
    while _is_running(int(pid_file.read_text())) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _is_running(int(pid_file.read_text()))


def test_blender_ends_with_a_killed_parent(tmp_path: Path) -> None:
    """The parent is killed and cannot end its child; without the watch the child would stay."""
    body = """
import os, runpy, time, types
for name in ("bpy", "mathutils"):
    sys.modules[name] = types.ModuleType(name)
sys.modules["bpy"].app, sys.modules["mathutils"].Matrix = types.SimpleNamespace(version=(4, 2)), None
worker = runpy.run_path({worker!r})
if {watches}:
    worker["end_with_parent"]()
Path({pid_file!r}).write_text(str(os.getpid()))
time.sleep(60)
"""
    caller = "import sys; from pathlib import Path; from illuminerf.cues.blender_renderer import run_blender; "
    caller += "run_blender([sys.argv[1], sys.argv[2]], Path(sys.argv[2]) / 'log.txt', 60)"
    for watches in (True, False):
        pid_file = tmp_path / f"pid_{watches}"
        text = body.format(worker=str(blender_renderer._WORKER), watches=watches, pid_file=str(pid_file))
        parent = subprocess.Popen([sys.executable, "-c", caller, program(tmp_path, text), str(tmp_path)])
        _wait_until(lambda file=pid_file: file.exists() and bool(file.read_text()), 30)  # type: ignore[misc]
        child = int(pid_file.read_text())
        parent.kill()
        parent.wait()
        ended = _wait_until(lambda pid=child: not _is_running(pid), 10 if watches else 2)  # type: ignore[misc]
        assert ended == watches
        if not ended:
            os.kill(child, signal.SIGKILL)


def _wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    return condition()


@pytest.mark.parametrize(
    ("said", "fix"),
    [
        ("OSError: [Errno 28] No space left on device: 'a.exr'", "TMPDIR"),
        ("Error writing file: No space left on device", "TMPDIR"),
        ("CUDA error: Out of memory in cuMemAlloc", "graphics card"),
        ("Failed to create OptiX context", "graphics card"),
        ("System is out of GPU memory", "graphics card"),
        ("Cycles finds no CUDA device on this machine", "graphics card"),
        ("Malloc returns null: len=123", "fewer workers"),
        ("MemoryError", "fewer workers"),
    ],
)
@pytest.mark.parametrize("status", [0, 1])
def test_shortages_of_the_machine_are_no_fault_of_the_item(tmp_path: Path, said: str, fix: str, status: int) -> None:
    body = f"print({said!r})\nfor i in range(20): print('Saved', i)\nsys.exit({status})"
    with pytest.raises(UserError, match=fix) as caught:
        BlenderItemRenderer(1, FEW, program(tmp_path, body)).render([(sphere_mesh(1), Material())], SMALL, [WHITE], 0)
    assert not isinstance(caught.value, BlenderFailed)


def test_a_killed_blender_is_no_fault_of_the_item_but_a_crashed_one_is(tmp_path: Path) -> None:
    for number, kind in ((signal.SIGKILL, UserError), (signal.SIGSEGV, BlenderFailed)):
        executable = program(tmp_path, f"import os; os.kill(os.getpid(), {int(number)})")
        with pytest.raises(UserError) as caught:
            BlenderItemRenderer(1, FEW, executable).render([(sphere_mesh(1), Material())], SMALL, [WHITE], 0)
        assert type(caught.value) is kind


def test_a_job_that_cannot_be_written_is_no_fault_of_the_item(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(blender_renderer, "write_job", full)
    with pytest.raises(UserError, match="cannot be written; got .*No space left.*Fix: free") as caught:
        BlenderItemRenderer(1, FEW, program(tmp_path, "")).render([(sphere_mesh(1), Material())], SMALL, [WHITE], 0)
    assert not isinstance(caught.value, BlenderFailed)


def test_the_limit_of_a_task_caps_the_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ILLUMINERF_TASK_SECONDS", raising=False)
    assert capped_timeout(BlenderItemRenderer().timeout_seconds) == 1500
    monkeypatch.setenv("ILLUMINERF_TASK_SECONDS", "600")
    assert capped_timeout(1500.0) == pytest.approx(480) and capped_timeout(30.0) == 30
    for wrong in ("soon", "0", "nan"):
        monkeypatch.setenv("ILLUMINERF_TASK_SECONDS", wrong)
        with pytest.raises(UserError, match="ILLUMINERF_TASK_SECONDS"):
            capped_timeout(1500.0)


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")  # an ended child that nobody has waited for is no more than an entry
    return not (stat.exists() and stat.read_text().rsplit(")", 1)[1].split()[0] == "Z")


def test_settings_are_checked() -> None:
    with pytest.raises(UserError, match="samples_per_pixel"):
        BlenderItemRenderer(0)
    with pytest.raises(UserError, match="timeout_seconds"):
        BlenderItemRenderer(1, timeout_seconds=0.0)


# With Blender

MANY = CueSampling(samples_per_pixel=64)
# Mean radiance, relative, and dB in sRGB against Mitsuba at 64 paths. A dielectric is 7% darker in Blender, whose
# principled shader takes the light of the coat from the base; everything else is the same formula in both.
CUE_BOUNDS = {"diffuse": (0.01, 35.0), "ggx_005": (0.01, 40.0), "ggx_013": (0.01, 40.0), "ggx_034": (0.01, 36.0)}
DIELECTRIC = {"target": (0.12, 31.0), **CUE_BOUNDS}
METAL = {"target": (0.02, 36.0), **CUE_BOUNDS}


@pytest.mark.slow
@needs_blender
@pytest.mark.parametrize(("metallic", "bounds"), [(0.0, DIELECTRIC), (1.0, METAL)])
def test_both_renderers_agree(metallic: float, bounds: dict[str, tuple[float, float]]) -> None:
    parts, light = checkered_sphere(metallic), lamps(256)
    blender = BlenderItemRenderer(64, MANY, BLENDER, bakes_properties=False).render(parts, CAMERA, [light], 0)
    mitsuba: Callable[[EnvironmentMap], RenderedItem] = lambda light: MitsubaItemRenderer(64, MANY, False).render(  # noqa: E731
        parts, CAMERA, [light], 0
    )
    right = mitsuba(light)
    found = differences(blender, right)
    for name, (radiance, decibels) in bounds.items():
        assert found[name][0] < radiance and found[name][1] > decibels, (name, found)
    np.testing.assert_allclose(blender.alpha.mean(), right.alpha.mean(), rtol=2e-3)
    np.testing.assert_array_equal(blender.base_color, right.base_color)
    # a light turned by an eighth is found out in every picture
    wrong = differences(blender, mitsuba(light.rotated(np.pi / 4)))
    for name, (_, decibels) in bounds.items():
        assert wrong[name][1] < decibels, (name, wrong)


@pytest.mark.slow
@needs_blender
def test_axes_of_the_light_and_seeds() -> None:
    """Red light from +x, green from +y, blue from +z: seen from (1, 1, 1) the sphere is so coloured, and dark
    where it is turned away. The same seed gives the same bytes, another one does not."""
    blank = EnvironmentMap(np.ones((256, 512, 3), np.float32))
    light = EnvironmentMap((blank.directions() > 0.98).astype(np.float32))
    camera = Cameras(look_at(np.full(3, 1.9), np.zeros(3))[None], CAMERA.intrinsics / 2, 32, 32)
    renderer = BlenderItemRenderer(4, CueSampling(samples_per_pixel=8), BLENDER)
    parts = [(sphere_mesh(4), Material())]
    first, again, other = (renderer.render(parts, camera, [light], seed) for seed in (3, 3, 4))
    diffuse = first.cues[0, :3]
    for axis in range(3):
        facing = first.normal[axis] > 0.9
        assert facing.any()
        strength = diffuse[:, facing].mean(1)
        assert strength.argmax() == axis and strength[axis] > 3 * np.delete(strength, axis).max()
        # the lamps reach 11 degrees about their axes, a sine of 0.2
        turned_away = (first.normal[axis] < -0.3) & (first.alpha == 1)
        assert turned_away.any() and (diffuse[axis][turned_away] == 0).all()
    np.testing.assert_array_equal(first.targets, again.targets)
    np.testing.assert_array_equal(first.cues, again.cues)
    assert (first.targets != other.targets).any() and (first.cues != other.cues).any()


@pytest.mark.slow
@needs_blender
@pytest.mark.parametrize("depth", [2, 3])
def test_bounces_and_camera_mean_the_same(depth: int) -> None:
    """A white corner in white light, by a camera with oblong pixels and its axis off the centre. One more bounce
    brightens it by a third and more."""
    pose = look_at(np.array([2.0, 2.2, 1.8]), np.zeros(3))
    camera = Cameras(pose[None], np.array([[60.0, 45.0, 20.0, 30.0]]), 48, 40)
    sampling = CueSampling(64, diffuse_depth=depth, specular_depth=depth)
    longer = CueSampling(64, diffuse_depth=depth + 1, specular_depth=depth + 1)
    blender = BlenderItemRenderer(4, sampling, BLENDER).render(corner(), camera, [WHITE], 0)
    mitsuba, brighter = (MitsubaItemRenderer(64, s).render(corner(), camera, [WHITE], 0) for s in (sampling, longer))
    found, wrong = differences(blender, mitsuba), differences(blender, brighter)
    for name in CUE_NAMES:
        assert found[name][0] < 0.02 and wrong[name][0] > 0.08, (name, found, wrong)
    covered = np.abs(blender.alpha - mitsuba.alpha).mean()
    assert covered < 0.02
    assert np.abs(blender.alpha - np.roll(mitsuba.alpha, 1, 1)).mean() > 1.5 * covered


@pytest.mark.slow
@needs_blender
def test_every_kind_of_material(tmp_path: Path) -> None:
    """In white light a metal shows about its colour, whether it is a number or per vertex, and a mix lies between."""
    ball = sphere_mesh(3)
    gold = (0.9, 0.6, 0.2)
    shade = np.full(len(ball.vertices), 0.2, np.float32)
    materials = [
        Material(gold, 0.2, 1.0),
        Material(np.tile(np.float32(gold), (len(ball.vertices), 1)), shade, shade / np.float32(0.2)),
        Material(gold, 0.2, 0.5),
    ]
    placed: Parts = []
    for offset, material in zip((-1.0, 0.0, 1.0), materials, strict=True):
        vertices = ball.vertices * np.float32(0.3) + np.float32([0, offset, 0])
        placed.append((TriangleMesh(vertices, ball.faces, ball.vertex_normals), material))
    camera = turntable_cameras(1, 8.0, 0.35, 32, 96, elevation_radians=0.0)
    item = BlenderItemRenderer(64, FEW, BLENDER).render(placed, camera, [WHITE], 0)
    centres = np.round(camera.project(np.array([[0, y, 0] for y in (-1.0, 0.0, 1.0)]))[0][0, :, 0]).astype(int)
    middles = [item.targets[0, :, 14:18, c - 2 : c + 2].mean((1, 2)) for c in centres]
    for middle in middles:
        np.testing.assert_allclose(middle, gold, atol=0.04)
    assert np.abs(middles[0] - [0.6, 0.9, 0.2]).max() > 0.2  # colours in another order would be seen
