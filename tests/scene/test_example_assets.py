"""Example objects and lights: readable by the factory, with the materials they were given, the same every time."""

from pathlib import Path

import numpy as np

from illuminerf.cues.light_library import light_paths
from illuminerf.cues.object_files import load_object
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.example_assets import write_example_assets


def test_objects_are_read_with_their_materials(tmp_path: Path) -> None:
    objects, lights = write_example_assets(tmp_path / "a", resolution=32, light_height=16)
    found = {path.stem: load_object(path, np.random.default_rng(0)) for path in sorted(objects.iterdir())}
    assert sorted(found) == ["ball", "board", "cup", "duck", "pebble", "torus"]
    assert all(np.abs(mesh.vertices).max() <= 1.0001 for parts in found.values() for mesh, _ in parts)
    ball, torus, duck = (found[name][0][1] for name in ("ball", "torus", "duck"))
    assert (ball.metallic, ball.roughness) == (1.0, 0.25) and duck.metallic == 0.0
    assert torus.is_textured and not duck.is_textured
    duck_colors = np.asarray(duck.base_color)
    assert duck_colors.ndim == 2 and duck_colors.std(0).max() > 0.05, "the duck has a beak and eyes"
    board = found["board"][0][0].vertices
    assert np.ptp(board[:, 2]) < 0.2 * np.ptp(board[:, 0]), "the board lies flat in a z-up world"
    means = [EnvironmentMap.load(path).resized(16).linear_rgb.mean((0, 1)) for path in light_paths(lights)]
    assert len(means) == 4 and len({tuple(mean.round(3)) for mean in means}) == 4


def test_the_same_bytes_every_time(tmp_path: Path) -> None:
    for name in "ab":
        write_example_assets(tmp_path / name, resolution=24, light_height=8)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert len(files) == 10
    assert all((tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes() for path in files)
