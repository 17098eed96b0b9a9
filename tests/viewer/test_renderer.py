"""What the viewer shows, without a browser."""

from pathlib import Path

import numpy as np
import pytest
import torch

from illuminerf.scene.cameras import Cameras, look_at, turntable_cameras
from illuminerf.viewer.finished_run import find_run
from illuminerf.viewer.refinement import Speed, refined, sizes
from illuminerf.viewer.renderer import AS_PHOTOGRAPHED, CUES, FAR, MODES, NORMALS, Look, ViewRenderer, band_of, code_at
from illuminerf.viewer.server import page_camera


@pytest.fixture(scope="module")
def renderer(run_folder: Path) -> ViewRenderer:
    return ViewRenderer(find_run(run_folder), "cpu")


def camera(side: int = 24) -> Cameras:
    return turntable_cameras(1, 3.0, 0.6, side, side, 0.3)


def test_lights_modes_and_codes_of_a_run(renderer: ViewRenderer) -> None:
    assert renderer.lights == ("dawn", "dusk", AS_PHOTOGRAPHED)
    assert renderer.modes("dawn") == MODES and not set(renderer.modes(AS_PHOTOGRAPHED)) & set(CUES)
    assert renderer.num_latents("dusk") == 4 and renderer.num_latents(AS_PHOTOGRAPHED) == 0


def test_every_light_and_mode_gives_another_picture_over_white(renderer: ViewRenderer) -> None:
    looks = [Look(light, mode) for light in renderer.lights for mode in renderer.modes(light)]
    pictures = {look: renderer.render(camera(), look).srgb for look in looks if look.mode != "GGX 0.13 cue"}
    for look, srgb in pictures.items():
        assert srgb.shape == (24, 24, 3) and srgb.min() >= 0 and srgb.max() <= 1
        np.testing.assert_allclose(srgb[0, 0], 1, atol=0.02)
        assert np.abs(srgb - 1).max() > 0.1, look
    assert np.abs(pictures[Look("dawn")] - pictures[Look("dusk")]).max() > 0.01
    cue = [pictures[Look(light, "diffuse cue")][8:16, 8:16].mean((0, 1)) for light in ("dawn", "dusk")]
    assert cue[0][0] > cue[0][2] and cue[1][0] < cue[1][2], "one light is red, the other blue"


def test_normals_face_the_camera_in_the_middle(renderer: ViewRenderer) -> None:
    view = camera(25)
    normal = 2 * renderer.render(view, Look("dawn", NORMALS)).srgb[12, 12] - 1
    toward = view.positions[0] / np.linalg.norm(view.positions[0])
    assert normal @ toward > 0.98 > 0 > normal @ -toward


def test_depth_is_that_of_the_sphere(renderer: ViewRenderer) -> None:
    depth = renderer.render(camera(25), Look("dawn")).depth
    assert depth[12, 12] == pytest.approx(2.5, abs=0.02) and depth[0, 0] == FAR
    outline = depth[depth < FAR].max()
    assert 2.6 < outline < 3.05, "seen along the axis, a sphere is deepest at its outline"


def test_codes_are_blended_in_straight_lines() -> None:
    codes = torch.tensor([[1.0, 0.0], [0.0, 4.0]])
    assert code_at(codes, 0.0) is None and code_at(None, 1.5) is None
    for place, wanted in (
        (0.5, [0.5, 0.0]),
        (1.0, [1.0, 0.0]),
        (1.25, [0.75, 1.0]),
        (2.0, [0.0, 4.0]),
        (9.0, [0.0, 4.0]),
    ):
        assert code_at(codes, place).tolist() == pytest.approx(wanted)  # type: ignore[union-attr]


def test_the_latent_changes_the_picture_little_by_little(renderer: ViewRenderer) -> None:
    zero, near, far = (renderer.render(camera(), Look("dawn", latent=place)).srgb for place in (0.0, 0.05, 1.0))
    assert 0 < np.abs(near - zero).max() < np.abs(far - zero).max()


@pytest.mark.parametrize("rows", [1, 7, 24])
def test_bands_make_up_the_picture(renderer: ViewRenderer, rows: int) -> None:
    whole = renderer.render(camera(), Look("dawn"))
    bands = list(renderer.bands(camera(), Look("dawn"), rows))
    np.testing.assert_allclose(np.concatenate([band.srgb for band in bands]), whole.srgb, atol=1e-4)
    wrong = renderer.render(band_of(camera(), 3, 7), Look("dawn"))
    assert np.abs(wrong.srgb - whole.srgb[:7]).max() > 0.1, "a shifted band must fail"


def test_sizes_grow_from_a_quick_one_to_the_finest() -> None:
    assert sizes(512, 1e5, 1.5) == [134, 268, 512]
    assert sizes(512, 1.0, 1.5)[0] == 48 and sizes(512, 1e9, 1.5) == [512]
    assert all(
        found[-1] == 300 and found == sorted(set(found)) for found in (sizes(300, s, 1.0) for s in (1.0, 1e4, 1e5))
    )


def test_refinement_ends_where_something_changed(renderer: ViewRenderer) -> None:
    asked: list[int] = []

    def stale() -> bool:
        asked.append(1)
        return len(asked) > 3

    shown = list(refined(renderer, camera, Look("dawn"), 96, Speed({"relit": 5e3}), lambda: False))
    assert [picture.srgb.shape[0] for picture, _ in shown] == [48, 96]
    cut = list(refined(renderer, camera, Look("dawn"), 96, Speed({"relit": 5e3}), stale))
    assert len(cut) < 2 and len(asked) == 4


def test_the_camera_of_a_page_sees_what_the_page_shows() -> None:
    pose = look_at(np.array([2.0, 1.0, 1.0]), np.zeros(3))
    view = page_camera(pose[:3, :3] @ np.diag([1.0, -1.0, -1.0]), pose[:3, 3], 0.7, (601, 997), 100)
    np.testing.assert_allclose(view.world_from_camera[0], pose, atol=1e-12)
    assert (view.height, view.width) == (60, 100)
    # half way up the image is half of the vertical field of view's tangent, and so on across
    up, right = pose[:3, 1], pose[:3, 0]
    edge = np.linalg.norm(pose[:3, 3]) * np.tan(0.35)
    points, _ = view.project(np.stack([edge * up, edge * 997 / 601 * right]))
    np.testing.assert_allclose(points[0], [[50, 0], [100, 30]], atol=1e-6)
