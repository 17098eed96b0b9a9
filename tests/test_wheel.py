"""What is installed from a wheel has everything that the source tree has."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_the_wheel_holds_weights_the_demo_and_types(tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(ROOT / "src", source / "src", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    done = subprocess.run([*command, "--wheel-dir", str(tmp_path), str(source)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    inside = zipfile.ZipFile(wheel)
    names = {name for name in inside.namelist() if name.startswith("illuminerf/")}
    package = source / "src" / "illuminerf"
    assert names == {f"illuminerf/{path.relative_to(package)}" for path in package.rglob("*") if path.is_file()}
    for name in (
        "py.typed",
        "weights/embedded/unet/diffusion_pytorch_model.safetensors",
        "bundled/demo_capture/cameras.json",
    ):
        assert f"illuminerf/{name}" in names
    (entry_points,) = (name for name in inside.namelist() if name.endswith("entry_points.txt"))
    assert b"illuminerf = illuminerf.entry:main" in inside.read(entry_points)
