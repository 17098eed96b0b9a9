"""A photograph under a turning light: cues of the turned light, frames that resume, a ball that shows the light."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from illuminerf import rotating_light
from illuminerf.cues.renderer import CUE_CHANNELS, CueSampling, render_cues
from illuminerf.data.capture import load_capture, write_capture
from illuminerf.diffusion.relighting_model import save_model
from illuminerf.rotating_light import Config
from illuminerf.scene.cameras import Cameras, look_at
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_exr, read_png
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.video import read_video, video_size
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import tiny_model, with_noise_in_every_weight

SIZE = 40
CONFIG = Config(
    view=1, num_frames=4, sampling=CueSampling(samples_per_pixel=4), num_samples=2, num_steps=2, device="cpu"
)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path, Path]:
    """Geometry (a ball), a capture of two discs, a lamp towards +x, and a model that is not trained."""
    folder = tmp_path_factory.mktemp("rotating")
    geometry, capture, light, model = (folder / name for name in ("geometry", "capture", "lamp.exr", "model"))
    geometry.mkdir()
    ball = trimesh.creation.icosphere(2, 0.6)
    TriangleMesh(np.float32(ball.vertices), np.int32(ball.faces), np.float32(ball.vertex_normals)).save_glb(
        geometry / "mesh.glb"
    )
    axis = np.linspace(-1, 1, SIZE)
    alpha = (axis[:, None] ** 2 + axis**2 < 0.4).astype(np.float32)
    images = [np.dstack([np.full((SIZE, SIZE, 3), 0.5, np.float32), alpha])] * 2
    poses = np.stack([look_at(np.array([3.0, k, 0.5]), np.zeros(3)) for k in range(2)])
    cameras = Cameras(poses, np.tile([60.0, 60.0, SIZE / 2, SIZE / 2], (2, 1)), SIZE, SIZE)
    write_capture(capture, images, cameras, ["a", "b"], 1.0, np.zeros(3), "masked")
    lamp = np.full((16, 32, 3), 0.05, np.float32)
    towards = EnvironmentMap(lamp, "lamp").directions()
    lamp[towards[..., 0] > 0.9] = 5
    EnvironmentMap(lamp, "lamp").save(light)
    save_model(with_noise_in_every_weight(tiny_model()), model)
    return geometry, capture, light, model


@pytest.fixture(scope="module")
def turned(inputs: tuple[Path, Path, Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rotating_light.render(*inputs, None, CONFIG, tmp_path_factory.mktemp("turned") / "out")


def frames(out: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted((out / "images").glob("*.png"))]


def test_cues_are_those_of_the_turned_light(inputs: tuple[Path, Path, Path, Path], turned: Path) -> None:
    geometry, capture, light, _ = inputs
    mesh, placed = TriangleMesh.load_glb(geometry / "mesh.glb"), EnvironmentMap.load(light)
    cameras = load_capture(capture).views.cameras
    found = np.stack(list(read_exr(turned / "cues" / "001.exr")[name] for name in CUE_CHANNELS))
    for turn, is_same in ((math.pi / 2, True), (-math.pi / 2, False)):
        (expected,) = render_cues(mesh, cameras, placed.rotated(turn), CONFIG.sampling, 0, [1])
        assert (np.abs(found - expected[:12]).max() < 1e-2) == is_same


def test_frames_have_the_photographs_mask_and_change(turned: Path) -> None:
    pictures = [read_png(path) for path in sorted((turned / "images").glob("*.png"))]
    assert len(pictures) == 4 and video_size(turned / "rotating.mp4") == (SIZE, SIZE)
    assert len(set(frames(turned))) == 4
    assert all(np.array_equal(picture[..., 3], pictures[0][..., 3]) for picture in pictures)
    assert (turned / "rotating.gif").read_bytes()[:3] == b"GIF"
    middles = [frame[-6:-2, 2:6].max() for frame in read_video(turned / "rotating.mp4", SIZE)]
    assert middles[0] > 200 and middles[2] < 120, "the lamp beside the camera, and behind the object"


def test_interrupted_and_resumed_equals_uninterrupted(
    inputs: tuple[Path, Path, Path, Path], turned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(rotating_light, "write_mp4", fails)
        with pytest.raises(KeyboardInterrupt):
            rotating_light.render(*inputs, None, CONFIG, tmp_path / "out")
    (tmp_path / "out" / "images" / "002.png").unlink()
    rotating_light.render(*inputs, None, CONFIG, tmp_path / "out")
    assert frames(tmp_path / "out") == frames(turned)
    assert (tmp_path / "out" / "DONE").read_text() == (turned / "DONE").read_text()


def test_mistakes_are_told(inputs: tuple[Path, Path, Path, Path], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no view 2.*0 to 1"):
        rotating_light.render(*inputs, None, replace(CONFIG, view=2), tmp_path / "out")
    with pytest.raises(UserError, match="at least 1"):
        Config(num_frames=0)
