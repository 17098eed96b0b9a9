"""A light to look at: its panorama with axes, a mirror ball and a matte ball, and the sky seen from above.

Everything is toned, so that lamps keep their colour and dark rooms can be seen; only the text is exact.
"""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from illuminerf.scene.environment import EnvironmentMap, ball_normals, chrome_ball
from illuminerf.scene.images import composite, srgb_from_linear, to_uint8
from illuminerf.scene.tone import compressed

_WIDTH, _BALL, _MARGIN, _GAP = 768, 224, 44, 20
_TEXT_SIZE = 13
_SHADED_ROWS = 32  # of the light that a matte ball is lit by
_MID_GREY = 0.35
_INK = (40, 40, 40)
_Place = tuple[float | int, float | int]


def viewing_exposure(linear_rgb: np.ndarray) -> float:
    """A factor for looking at radiance: the mean of what is lit becomes a mid grey."""
    lit = linear_rgb[linear_rgb.max(-1) > 1e-4]
    return float(np.clip(_MID_GREY / max(float(np.minimum(lit, 4).mean()), 1e-6), 0.05, 8)) if lit.size else 1.0


def matte_ball(light: EnvironmentMap, size: int) -> tuple[np.ndarray, np.ndarray]:
    """A white diffuse ball under `light` seen from +x: linear_rgb [size, size, 3] and alpha [size, size].

    Its radiance is the irradiance over pi, summed over the directions of a small copy of the light.
    """
    normals, inside = ball_normals(size)
    small = light.resized(min(_SHADED_ROWS, light.linear_rgb.shape[0]))
    emitted = (small.linear_rgb * small.solid_angles()).reshape(-1, 3).astype(np.float32)
    cosines = np.maximum(normals[inside].astype(np.float32) @ small.directions().reshape(-1, 3).T, 0)
    linear_rgb = np.zeros((size, size, 3), np.float32)
    linear_rgb[inside] = cosines @ emitted / np.pi
    return linear_rgb, inside.astype(np.float32)


def from_above(light: EnvironmentMap, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The upper half of the light as a disc, seen from above: +x points right, +y up, the zenith is the middle.

    The distance from the middle grows with the angle from the zenith. Returns linear_rgb and alpha.
    """
    centres = (np.arange(size) + 0.5) / size * 2 - 1
    y, x = np.meshgrid(-centres, centres, indexing="ij")
    distance = np.hypot(x, y)
    angle = distance * (np.pi / 2)
    flat = np.sin(angle) / np.maximum(distance, 1e-9)
    inside = distance < 1
    directions = np.stack([flat * x, flat * y, np.cos(angle)], -1)
    return light.radiance(directions) * inside[..., None], inside.astype(np.float32)


def light_preview(light: EnvironmentMap) -> np.ndarray:
    """The whole sheet: uint8 [height, width, 3]."""
    exposure = viewing_exposure(light.linear_rgb)
    height = _WIDTH // 2
    sheet = Image.new("RGB", (_WIDTH + 2 * _MARGIN, height + _BALL + 4 * _MARGIN), "white")
    draw = ImageDraw.Draw(sheet)
    rows = min(height, light.linear_rgb.shape[0])
    panorama = Image.fromarray(_toned(light.resized(rows).linear_rgb, exposure))
    sheet.paste(panorama.resize((_WIDTH, height), Image.Resampling.BICUBIC), (_MARGIN, _MARGIN))
    _label_panorama(draw, height)
    top = height + 2 * _MARGIN + _GAP
    chrome, matte, above = (make(light, _BALL) for make in (chrome_ball, matte_ball, from_above))
    matte_exposure = exposure if matte[0].max() * exposure > 0.05 else viewing_exposure(matte[0])
    spacing = (_WIDTH - 3 * _BALL) // 2 + _BALL
    for number, ((ball, alpha), factor) in enumerate(
        ((chrome, exposure), (matte, matte_exposure), (above, exposure)),
    ):
        picture = to_uint8(composite(_toned(ball, factor) / 255, alpha, 1.0))
        sheet.paste(Image.fromarray(picture), (_MARGIN + number * spacing, top))
    _label_discs(draw, top, spacing)
    _write(draw, (_MARGIN, 10), f"{light.name}: {_numbers(light)}", "la")
    return np.asarray(sheet)


def _numbers(light: EnvironmentMap) -> str:
    height, width = light.linear_rgb.shape[:2]
    mean = ", ".join(f"{value:.3g}" for value in light.mean_radiance())
    brightest = int(light.linear_rgb.sum(-1).argmax())
    x, y, z = light.directions().reshape(-1, 3)[brightest]
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(np.clip(z, -1, 1)))
    return (
        f"{width} x {height}, mean radiance {mean}, brightest {light.linear_rgb.max():.4g} at azimuth {azimuth:.0f}, "
        f"elevation {elevation:.0f} degrees"
    )


def _toned(linear_rgb: np.ndarray, exposure: float) -> np.ndarray:
    exposed = linear_rgb * exposure
    return to_uint8(srgb_from_linear(compressed(exposed, max(1.0, float(exposed.max())))))


def _label_panorama(draw: ImageDraw.ImageDraw, height: int) -> None:
    """Azimuths below, elevations at the left, and where the axes meet the sphere."""
    for azimuth in range(-180, 181, 45):
        x = _MARGIN + (180 - azimuth) / 360 * (_WIDTH - 1)
        draw.line([(x, _MARGIN + height), (x, _MARGIN + height + 5)], fill=_INK)
        _write(draw, (x, _MARGIN + height + 8), f"{azimuth:+d}°" if azimuth else "0°", "ma")
    for elevation in (90, 45, 0, -45, -90):
        y = _MARGIN + (90 - elevation) / 180 * (height - 1)
        draw.line([(_MARGIN - 5, y), (_MARGIN, y)], fill=_INK)
        _write(draw, (_MARGIN - 8, y), f"{elevation:+d}°" if elevation else "0°", "rm")
    middle = _MARGIN + height / 2
    for name, azimuth in (("-x", 172), ("+y", 90), ("+x", 0), ("-y", -90), ("-x", -172)):
        _mark(draw, (_MARGIN + (180 - azimuth) / 360 * _WIDTH, middle), name)
    _mark(draw, (_MARGIN + _WIDTH / 2, _MARGIN + 14), "+z, the whole row")
    _mark(draw, (_MARGIN + _WIDTH / 2, _MARGIN + height - 14), "-z, the whole row")


def _label_discs(draw: ImageDraw.ImageDraw, top: int, spacing: int) -> None:
    captions = ("mirror ball, seen from +x", "matte ball, seen from +x", "the sky from above; --rotate turns it")
    for number, caption in enumerate(captions):
        left = _MARGIN + number * spacing
        _write(draw, (left + _BALL / 2, top + _BALL + 26), caption, "ma")
        names = ("-y", "+y", "+z", "-z") if number < 2 else ("-x", "+x", "+y", "-y")
        _write(draw, (left - 5, top + _BALL / 2), names[0], "rm")
        _write(draw, (left + _BALL + 5, top + _BALL / 2), names[1], "lm")
        _write(draw, (left + _BALL / 2, top - 4), names[2], "md")
        _write(draw, (left + _BALL / 2, top + _BALL + 6), names[3], "ma")
    _draw_turn(draw, (_MARGIN + 2 * spacing + _BALL / 2, top + _BALL / 2))


def _draw_turn(draw: ImageDraw.ImageDraw, centre: _Place) -> None:
    """An arrow counter-clockwise about the middle, as a positive --rotate turns the light."""
    radius = 0.3 * _BALL
    x, y = centre
    for width, colour in ((5, "black"), (2, "white")):
        draw.arc((x - radius, y - radius, x + radius, y + radius), -60, 0, fill=colour, width=width)
    tip = (x + radius * np.cos(np.radians(68)), y - radius * np.sin(np.radians(68)))
    ends = [(x + r * np.cos(np.radians(58)), y - r * np.sin(np.radians(58))) for r in (radius - 8, radius + 8)]
    draw.polygon([tip, *ends], fill="white", outline="black")


def _mark(draw: ImageDraw.ImageDraw, place: _Place, text: str) -> None:
    """Readable on any ground."""
    draw.text(place, text, "white", _font(), "mm", stroke_width=2, stroke_fill="black")


def _write(draw: ImageDraw.ImageDraw, place: _Place, text: str, anchor: str) -> None:
    draw.text(place, text, _INK, _font(), anchor)


def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(_TEXT_SIZE)
