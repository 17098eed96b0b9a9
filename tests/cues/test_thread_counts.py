"""The bytes of a picture do not depend on how many threads rendered it."""

import hashlib
import os
import subprocess
import sys

import pytest

from illuminerf.cues.mitsuba_variant import find_llvm

# prints a digest of the cues, of their coverage and of AOVs
PROGRAM = """
import hashlib, importlib, sys
import numpy as np
from illuminerf.cues import mitsuba_variant
variant, threads, spp, seed = sys.argv[1], *(int(word) for word in sys.argv[2:])
if variant == "scalar_rgb":
    mitsuba_variant.find_llvm = lambda: None
mi = mitsuba_variant.load_mitsuba()
assert mi.variant() == variant
from illuminerf.cues.mitsuba_scene import MitsubaScene
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
light = EnvironmentMap(np.random.default_rng(0).random((8, 16, 3), np.float32))
scene = MitsubaScene({"ball": {"type": "sphere", "bsdf": {"type": "diffuse"}}}, light)
camera = turntable_cameras(1, 3.2, 0.75, 25, 24)
digests = set()
for count in [threads] * 3:
    importlib.import_module("drjit").set_thread_count(count)
    path = scene.render(camera, 0, 3, spp, seed)
    aovs = scene.render_aovs("normal:sh_normal,depth:depth", camera, 0, spp, seed)
    assert path.shape == (25, 24, 4) and aovs.shape == (25, 24, 4) and path.mean() > 0.1
    digests.add(hashlib.sha256(path.tobytes() + aovs.tobytes()).hexdigest())
print(*digests)
"""


def digests(variant: str, threads: int, samples_per_pixel: int, seed: int = 5) -> list[str]:
    """Digests of a picture that is rendered three times in a process of its own."""
    command = [sys.executable, "-c", PROGRAM, variant, *map(str, (threads, samples_per_pixel, seed))]
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ)
    return done.stdout.split()


@pytest.mark.parametrize("samples_per_pixel", [16, 100])
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_bytes_do_not_depend_on_threads(variant: str, samples_per_pixel: int) -> None:
    if variant == "llvm_ad_rgb" and find_llvm() is None:
        pytest.skip("no libLLVM on this machine")
    one = digests(variant, 1, samples_per_pixel)
    assert len(one) == 1 and len(one[0]) == len(hashlib.sha256().hexdigest())
    assert digests(variant, 8, samples_per_pixel) == one
    if samples_per_pixel == 16:
        assert digests(variant, 1, samples_per_pixel, seed=6) != one
