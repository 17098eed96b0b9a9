"""`illuminerf lights`: which lights there are by name, and a look at any light before hours are spent on it."""

import math
from pathlib import Path

import tyro
from rich.markup import escape

from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import write_png
from illuminerf.scene.light_preview import light_preview
from illuminerf.scene.named_lights import NAMED_LIGHTS, find_light
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say


def list_command() -> None:
    """List the lights that come with the package: give their names to --light."""
    for name, light in NAMED_LIGHTS.items():
        say(f"[bold]{name}[/bold]: {escape(light.description)}", markup=True)


def preview_command(
    light: tyro.conf.Positional[Path],
    out: Path = Path("light.png"),
    rotate: float = 0.0,
    exposure: float = 0.0,
    ldr_peak: float = 1.0,
) -> None:
    """Draw a light with its axes, a mirror ball, a matte ball, and the sky from above.

    Args:
        light: Equirectangular map or the name of a bundled light.
        out: The .png to write.
        rotate: As in relight, degrees counter-clockwise seen from above.
        exposure: As in relight, stops; the picture itself is always exposed to be seen.
        ldr_peak: As in relight, the radiance that a PNG's or JPEG's white stands for.
    """
    if out.suffix.lower() != ".png":
        raise UserError("the preview is a PNG", got=str(out), fix="let --out end in .png")
    write_png(out, light_preview(_placed(light, rotate, exposure, ldr_peak)) / 255)
    say(f"done: {out}")


def convert_command(
    light: tyro.conf.Positional[Path],
    out: Path,
    rotate: float = 0.0,
    exposure: float = 0.0,
    ldr_peak: float = 1.0,
) -> None:
    """Write a light as EXR: one of a name, a PNG or JPEG that is expanded, or any that is turned or exposed.

    Args:
        light: Equirectangular map or the name of a bundled light.
        out: The .exr to write.
        rotate: Degrees counter-clockwise seen from above.
        exposure: Stops by which it is made brighter.
        ldr_peak: Radiance that a PNG's or JPEG's white stands for.
    """
    if out.suffix.lower() != ".exr":
        raise UserError("lights are written as EXR", got=str(out), fix="let --out end in .exr")
    _placed(light, rotate, exposure, ldr_peak).save(out)
    say(f"done: {out}")


def _placed(light: Path, rotate: float, exposure: float, ldr_peak: float) -> EnvironmentMap:
    if not math.isfinite(rotate) or not abs(exposure) <= 30:
        raise UserError(
            "a light is turned by some degrees and exposed by -30 to 30 stops", got=f"{rotate} and {exposure}"
        )
    return find_light(light, ldr_peak).rotated(math.radians(rotate)).exposed(exposure)
