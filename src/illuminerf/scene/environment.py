"""Environment maps: linear radiance from every direction.

Equirectangular, row 0 is straight up (+z). direction = (cos az cos el, sin az cos el, sin el), azimuth +pi
at the left edge, 0 (the +x axis) in the middle, -pi at the right edge.
"""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from illuminerf.scene.images import linear_from_srgb, read_png, read_rgb_exr, write_rgb_exr
from illuminerf.scene.radiance_hdr import read_hdr
from illuminerf.scene.tone import expanded
from illuminerf.workflow.errors import UserError

_UNDERSHOOT = 0.05  # of the mean radiance
_TURNING_SAMPLES = 3  # of the old map, along each side of a new pixel
_LDR_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class EnvironmentMap:
    """Light from infinity.

    Attributes:
        linear_rgb: float32 [height, 2 * height, 3], linear rec.709 radiance, non-negative, unclipped.
        name: a short name for tables and reports.
    """

    linear_rgb: np.ndarray
    name: str = "light"

    def __post_init__(self) -> None:
        image, label = self.linear_rgb, f"the light '{self.name}'"
        if image.ndim != 3 or image.shape[2] != 3 or image.shape[1] != 2 * image.shape[0] or image.size == 0:
            raise UserError(
                f"{label} is not an equirectangular map",
                got=f"{image.shape[1]} x {image.shape[0]} pixels" if image.ndim == 3 else f"shape {image.shape}",
                wanted="width twice the height, 3 channels",
                fix="choose a panorama of all directions, made for lighting; an ordinary photograph is none",
            )
        if not np.isfinite(image).all():
            raise UserError(
                f"{label} has {int((~np.isfinite(image)).sum())} NaN or infinite values",
                wanted="finite radiance",
                fix="replace them, for example by the neighbouring pixels",
            )
        if image.min() < 0:
            raise UserError(
                f"{label} has negative radiance",
                got=f"{image.min():.3g}",
                wanted="0 or more",
                fix="clip it at 0",
            )
        if image.max() <= 0:
            raise UserError(f"{label} is all black", fix="choose a light that emits something")

    @staticmethod
    def load(path: Path, ldr_peak: float = 1.0) -> "EnvironmentMap":
        """Read an EXR or Radiance HDR map; PNG and JPEG are taken as sRGB, with a warning.

        Args:
            ldr_peak: radiance that the white of a PNG or JPEG stands for; the rest is expanded along with it.

        Raises:
            UserError: missing, unreadable, not 2:1, or with values no light has.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if not path.is_file():
            raise UserError(f"the light {path} does not exist", wanted="an .exr or .hdr file", fix="check the path")
        if suffix == ".exr":
            image = read_rgb_exr(path)
        elif suffix == ".hdr":
            image = read_hdr(path)
        elif is_low_range(path):
            image = expanded(linear_from_srgb(read_png(path)[..., :3]), ldr_peak)
        else:
            raise UserError(
                f"{path.name} is not a known kind of light",
                got=suffix or "no suffix",
                wanted=".exr, .hdr, .png or .jpg",
            )
        # resampling filters undershoot beside lamps: a small dip is rounding, a larger one a broken file
        if np.isfinite(image).all() and -_UNDERSHOOT * image.mean() < image.min() < 0:
            image = np.maximum(image, 0)
        light = EnvironmentMap(np.ascontiguousarray(image, np.float32), path.stem)
        if is_low_range(path):
            outcome = (
                "are cut off at 1, so shadows will be too soft and highlights too dark. Prefer an .exr or .hdr map, "
                "or guess with --ldr-peak how bright they are"
                if ldr_peak == 1
                else f"are taken to reach {ldr_peak:g}, which is a guess. Prefer an .exr or .hdr map"
            )
            warnings.warn(f"{path.name} is a low dynamic range image: lamps and the sun {outcome}.", stacklevel=2)
        return light

    def save(self, path: Path) -> None:
        """Write as single-precision linear EXR (the sun does not fit into a half)."""
        write_rgb_exr(path, self.linear_rgb, half=False)

    def rotated(self, radians: float) -> "EnvironmentMap":
        """Turn the light about +z, counter-clockwise seen from above, interpolating between columns."""
        width = self.linear_rgb.shape[1]
        shift = radians / (2 * np.pi) * width  # azimuth grows to the left: a turn by +phi moves columns left
        whole = int(np.floor(shift))
        part = np.float32(shift - whole)
        left = np.roll(self.linear_rgb, -whole, axis=1)
        if part < 1e-6:
            return replace(self, linear_rgb=left)
        return replace(self, linear_rgb=(1 - part) * left + part * np.roll(left, -1, axis=1))

    def turned(self, rotation: np.ndarray) -> "EnvironmentMap":
        """Turn the light by any rotation [3, 3]: what came from direction d comes from `rotation @ d`."""
        height = self.linear_rgb.shape[0]
        fine = EnvironmentMap(np.ones((height * _TURNING_SAMPLES, 2 * height * _TURNING_SAMPLES, 3), np.float32))
        weights = fine.solid_angles().astype(np.float32)  # pixels near the poles are averaged by area
        rows = []
        for row in range(height):
            band = slice(row * _TURNING_SAMPLES, (row + 1) * _TURNING_SAMPLES)
            values = self.radiance(fine.directions(band) @ rotation.astype(np.float32)) * weights[band]
            cells = values.reshape(_TURNING_SAMPLES, 2 * height, _TURNING_SAMPLES, 3).sum((0, 2))
            rows.append(cells / (_TURNING_SAMPLES * weights[band].sum()))
        return replace(self, linear_rgb=np.stack(rows))

    def exposed(self, stops: float) -> "EnvironmentMap":
        """Multiply the radiance by 2^stops."""
        return replace(self, linear_rgb=(self.linear_rgb * np.float32(2.0**stops)).astype(np.float32))

    def resized(self, height: int) -> "EnvironmentMap":
        """Average over areas, to more or fewer rows, so that small lamps keep their energy."""
        old = self.linear_rgb.shape[0]
        if height == old:
            return self
        rows, columns = _area_shares(old, height), _area_shares(2 * old, 2 * height)
        small = np.einsum("hH,HWc->hWc", rows, self.linear_rgb.astype(np.float64), optimize=True)
        return replace(self, linear_rgb=np.einsum("wW,hWc->hwc", columns, small, optimize=True).astype(np.float32))

    def directions(self, rows: slice = slice(None)) -> np.ndarray:
        """Unit directions of the pixel centres, float32 [height, width, 3], of all rows or of some."""
        height, width = self.linear_rgb.shape[:2]
        elevation = np.pi / 2 - (np.arange(height)[rows] + 0.5) * (np.pi / height)
        azimuth = np.pi - (np.arange(width) + 0.5) * (2 * np.pi / width)
        el, az = np.meshgrid(elevation, azimuth, indexing="ij")
        return np.stack([np.cos(az) * np.cos(el), np.sin(az) * np.cos(el), np.sin(el)], -1).astype(np.float32)

    def solid_angles(self) -> np.ndarray:
        """Steradians of each row's pixels, float64 [height, 1, 1]; they sum to 4 pi over the map."""
        height, width = self.linear_rgb.shape[:2]
        edges = np.sin(np.pi / 2 - np.arange(height + 1) * (np.pi / height))
        return ((edges[:-1] - edges[1:]) * (2 * np.pi / width))[:, None, None]

    def mean_radiance(self) -> np.ndarray:
        """Average over the sphere, float64 [3]: the look of a white diffuse point that sees everything."""
        return (self.linear_rgb * self.solid_angles()).sum((0, 1)) / (4 * np.pi)

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """Bilinear look-up, float32 [..., 3], of unit world directions [..., 3]."""
        height, width = self.linear_rgb.shape[:2]
        azimuth = np.arctan2(directions[..., 1], directions[..., 0])
        elevation = np.arcsin(np.clip(directions[..., 2], -1, 1))
        column = (np.pi - azimuth) * (width / (2 * np.pi)) - 0.5
        row = np.clip((np.pi / 2 - elevation) * (height / np.pi) - 0.5, 0, height - 1)
        left, top = np.floor(column).astype(int), np.floor(row).astype(int)
        bottom = np.minimum(top + 1, height - 1)
        u, v = (column - left)[..., None], (row - top)[..., None]
        image = self.linear_rgb
        left, right = left % width, (left + 1) % width
        upper = (1 - u) * image[top, left] + u * image[top, right]
        lower = (1 - u) * image[bottom, left] + u * image[bottom, right]
        return ((1 - v) * upper + v * lower).astype(np.float32)


def chrome_ball(light: EnvironmentMap, size: int) -> tuple[np.ndarray, np.ndarray]:
    """A mirror ball under `light` seen from +x: linear_rgb [size, size, 3] and alpha [size, size]."""
    normal, inside = ball_normals(size)
    reflected = 2 * normal[..., :1] * normal - np.array([1.0, 0.0, 0.0])
    return light.radiance(reflected) * inside[..., None], inside.astype(np.float32)


def ball_normals(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals [size, size, 3] of a ball seen from +x, and where it is [size, size]."""
    centres = (np.arange(size) + 0.5) / size * 2 - 1
    up, right = np.meshgrid(-centres, centres, indexing="ij")
    toward = np.sqrt(np.maximum(1 - right**2 - up**2, 0))
    # the camera looks along -x, so +y is to its right
    return np.stack([toward, right, up], -1), right**2 + up**2 < 1


def is_low_range(path: Path) -> bool:
    """Whether a file is of a kind that cannot hold radiance above 1."""
    return Path(path).suffix.lower() in _LDR_SUFFIXES


def _area_shares(old: int, new: int) -> np.ndarray:
    """How much of each of `new` cells each of `old` cells makes up: [new, old], rows sum to 1."""
    edges = np.arange(new + 1) * old / new
    shares = np.minimum(edges[1:, None], np.arange(1, old + 1)) - np.maximum(edges[:-1, None], np.arange(old))
    shares = np.clip(shares, 0, None)
    return shares / shares.sum(1, keepdims=True)
