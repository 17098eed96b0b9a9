"""Texture images decoded within limits and put together into materials."""

import io
import struct
import warnings
import zlib

import numpy as np
from PIL import Image

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.materials import Material
from illuminerf.cues.raw_objects import ImageFile, RawMaterial, ReadingLimits
from illuminerf.scene.images import linear_from_srgb

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF", "DDS")
"""What may be decoded: formats that run other programs (EPS) are not among them."""
OPAQUE_BYTE = 250
"""Alpha from here up, of 255, is opaque: exporters round."""
_OPAQUE = OPAQUE_BYTE / 255
_LINEAR_FROM_BYTE = linear_from_srgb(np.arange(256, dtype=np.float32) / 255)
_UNIT_FROM_BYTE = np.arange(256, dtype=np.float32) / 255
_DIELECTRIC = 0.04  # specular reflectance of glTF's non-metals


def decoded(image: ImageFile, limits: ReadingLimits) -> np.ndarray:
    """The pixels of an image, uint8 [h, w, 4], straight alpha; 16-bit images are rounded down.

    Raises:
        BrokenObject: "too large", or "unreadable" where it is corrupt or of an unknown format.
    """
    try:
        with warnings.catch_warnings():
            # Pillow warns at 89 megapixels; our own limit is checked before anything is decoded
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(image.content), formats=_FORMATS) as file:
                if file.width * file.height > limits.max_image_megapixels * 2**20:
                    raise _too_large(image, f"{file.width} x {file.height} pixels", limits)
                if file.mode.startswith("I") or file.mode == "F":
                    gray = np.asarray(file, np.float32)
                    scale = 256.0 if gray.max(initial=0) > 255 else 1.0
                    return np.asarray(Image.fromarray((gray / scale).astype(np.uint8)).convert("RGBA"))
                return np.asarray(file.convert("RGBA"))
    except Image.DecompressionBombError as error:
        raise _too_large(image, str(error), limits) from error
    except (OSError, SyntaxError, ValueError, IndexError, KeyError, TypeError, EOFError, OverflowError) as error:
        raise _corrupt(image, error) from error
    except (struct.error, zlib.error, NotImplementedError) as error:
        raise _corrupt(image, error) from error


def _corrupt(image: ImageFile, error: Exception) -> BrokenObject:
    return BrokenObject("unreadable", f"{image.name} is unreadable", got=f"{type(error).__name__}: {error}")


def _too_large(image: ImageFile, got: str, limits: ReadingLimits) -> BrokenObject:
    wanted = f"at most {limits.max_image_megapixels:g} megapixels"
    return BrokenObject("too large", f"{image.name} is too large", got=got, wanted=wanted)


class MaterialMaker:
    """Makes materials of raw ones, each once however many parts share it.

    Args:
        name: the object, for messages.
        limits: sizes of images and textures.
        num_textured: how many textured materials share `limits.max_texels`.
    """

    def __init__(self, name: str, limits: ReadingLimits, num_textured: int) -> None:
        self._name, self._limits = name, limits
        share = int(np.sqrt(limits.max_texels / max(num_textured, 1)))
        self._side = max(min(limits.max_texture_side, share), 8)
        self._made: dict[int, Material] = {}

    def textured(self, raw: RawMaterial, uv: np.ndarray) -> Material:
        """The material of `raw`'s images, with the part's `uv` [V, 2] (v = 0 at the bottom)."""
        if id(raw) not in self._made:
            self._made[id(raw)] = self._assembled(raw)
        made = self._made[id(raw)]
        return Material(
            made.base_color, made.roughness, made.metallic, self._tidied(raw, uv, made), normal_map=made.normal_map
        )

    def constant(self, raw: RawMaterial) -> Material:
        """The material without coordinates: images, if any, count by their mean."""
        if id(raw) not in self._made:
            self._made[id(raw)] = self._assembled(raw)
        made = self._made[id(raw)]
        if not made.is_textured:
            return made
        mean = np.asarray(made.base_color).mean((0, 1))
        return Material(
            (float(mean[0]), float(mean[1]), float(mean[2])),
            float(np.mean(made.roughness)),
            float(np.mean(made.metallic)),
        )

    def _tidied(self, raw: RawMaterial, uv: np.ndarray, made: Material) -> np.ndarray:
        height, width = np.asarray(made.base_color).shape[:2]
        uv = np.nan_to_num(uv, nan=0.0, posinf=0.0, neginf=0.0)
        if not raw.wraps:
            # Exact unless a face straddles the edge; half a texel keeps interpolation from wrapping round.
            half = np.array([0.5 / width, 0.5 / height])
            return np.clip(uv, half, 1 - half).astype(np.float32)
        # whole repeats say nothing and cost digits
        return np.clip(uv - np.floor(uv.min(0)), 0, 1e6).astype(np.float32)

    def _assembled(self, raw: RawMaterial) -> Material:
        color = np.asarray(raw.color or (1.0, 1.0, 1.0), np.float32)
        roughness = 1.0 if raw.roughness is None else raw.roughness
        metallic = 0.0 if raw.metallic is None else raw.metallic
        color_pixels = None if raw.color_image is None else decoded(raw.color_image, self._limits)
        self._check_opacity(raw, color_pixels)
        others = {
            name: decoded(image, self._limits)
            for name, image in (
                ("roughness", raw.roughness_image),
                ("metallic", raw.metallic_image if raw.metallic_image is not raw.roughness_image else None),
                ("normal", raw.normal_image),
                ("specular", raw.specular_image),
            )
            if image is not None
        }
        if raw.metallic_image is raw.roughness_image and "roughness" in others:
            others["metallic"] = others["roughness"]
        pixels = [*others.values(), *([] if color_pixels is None else [color_pixels])]
        size = _common_size(pixels, self._side)
        colors = color if color_pixels is None else color * _resized(color_pixels, (0, 1, 2), size, _LINEAR_FROM_BYTE)
        rough_map: np.ndarray | float = roughness
        metal_map: np.ndarray | float = metallic
        if "roughness" in others:
            rough_map = (
                roughness * _resized(others["roughness"], (raw.roughness_channel,), size, _UNIT_FROM_BYTE)[..., 0]
            )
        if "metallic" in others:
            metal_map = metallic * _resized(others["metallic"], (raw.metallic_channel,), size, _UNIT_FROM_BYTE)[..., 0]
        if raw.specular is not None:
            specular = np.asarray(raw.specular, np.float32)
            glossiness: np.ndarray | float = raw.glossiness
            if "specular" in others:
                specular = specular * _resized(others["specular"], (0, 1, 2), size, _LINEAR_FROM_BYTE)
                glossiness = glossiness * _resized(others["specular"], (3,), size, _UNIT_FROM_BYTE)[..., 0]
            colors, metal_map = _from_specular(colors, specular)
            rough_map = 1 - glossiness
        normal_map = _normals(others["normal"], size, raw.normal_scale) if "normal" in others else None
        if size is None:
            return Material(tuple(np.clip(colors, 0, 1).tolist()), float(rough_map), float(metal_map))
        height, width = size
        colors = np.broadcast_to(colors, (height, width, 3))
        colors = np.ascontiguousarray(np.clip(colors, 0, 1), np.float32)
        placeholder = np.zeros((1, 2), np.float32)
        return Material(colors, _clipped(rough_map), _clipped(metal_map), placeholder, normal_map=normal_map)

    def _check_opacity(self, raw: RawMaterial, color_pixels: np.ndarray | None) -> None:
        alphas = np.full(1, 255, np.uint8) if color_pixels is None else color_pixels[..., 3]
        if raw.alpha_image is not None:
            pixels = decoded(raw.alpha_image, self._limits)
            # a grey picture of opacity, or a picture whose own alpha is meant
            alphas = pixels[..., 3] if pixels[..., 3].min() < 255 else pixels[..., 0]
        if lets_light_through(raw, int(alphas.min())):
            raise transparent(self._name)


def lets_light_through(raw: RawMaterial, least_alpha_byte: int = 255, least_vertex_alpha: float = 1.0) -> bool:
    """Whether a material is (semi-)transparent, given the least alpha of its image and of the vertex colours.

    Blending with full alpha everywhere is opaque. Cut-outs count as transparent: what can be seen through a leaf's
    picture is not in the geometry that cues are made of.
    """
    if raw.transmits:
        return True
    if raw.alpha_cutoff is None:
        return min(raw.alpha, least_vertex_alpha) < _OPAQUE or least_alpha_byte < OPAQUE_BYTE
    return raw.alpha * least_vertex_alpha * least_alpha_byte / 255 < raw.alpha_cutoff


def transparent(name: str) -> BrokenObject:
    """The error that names a (semi-)transparent object."""
    return BrokenObject("transparent", f"{name} is (semi-)transparent")


def _common_size(images: list[np.ndarray], side: int) -> tuple[int, int] | None:
    """Height and width of the largest image, brought down to `side`."""
    if not images:
        return None
    height, width = max((image.shape[:2] for image in images), key=lambda shape: shape[0] * shape[1])
    scale = min(1.0, side / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def _resized(
    pixels: np.ndarray, channels: tuple[int, ...], size: tuple[int, int] | None, table: np.ndarray
) -> np.ndarray:
    """Chosen channels as float32 [h, w, channels] after a table look-up of the bytes, averaged or interpolated."""
    assert size is not None
    out = np.empty((*size, len(channels)), np.float32)
    for position, channel in enumerate(channels):  # one at a time: 8192 x 8192 floats are 256 MB
        plane = table[pixels[..., channel]]
        if plane.shape != size:
            shrinks = plane.size > size[0] * size[1]
            method = Image.Resampling.BOX if shrinks else Image.Resampling.BILINEAR
            plane = np.asarray(Image.fromarray(plane).resize((size[1], size[0]), method))
        out[..., position] = plane
    return out


def _normals(pixels: np.ndarray, size: tuple[int, int] | None, scale: float) -> np.ndarray:
    """Unit tangent-space normals [h, w, 3] that point outward."""
    # bytes 127 and 128 both stand for 0, so that a map without detail is exactly flat
    table = np.clip((np.arange(256, dtype=np.float32) - 127.5) / 127.5, -1, 1)
    table[127:129] = 0
    normals = _resized(pixels, (0, 1, 2), size, table) * np.array([scale, scale, 1], np.float32)
    normals[..., 2] = np.maximum(normals[..., 2], 1e-3)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _from_specular(diffuse: np.ndarray, specular: np.ndarray) -> tuple[np.ndarray, np.ndarray | float]:
    """Base colour and metallicity that reflect alike: diffuse = base (1 - m) (1 - 0.04), specular = mix(0.04, base, m),
    solved for m by perceived brightness."""
    weights = np.array([0.299, 0.587, 0.114], np.float32)
    strength = 1 - specular.max(-1)
    bright_diffuse = np.sqrt(diffuse**2 @ weights) * strength / (1 - _DIELECTRIC)
    bright_specular = np.sqrt(specular**2 @ weights)
    b = bright_diffuse + bright_specular - 2 * _DIELECTRIC
    root = np.sqrt(np.maximum(b * b - 4 * _DIELECTRIC * (_DIELECTRIC - bright_specular), 0))
    metallic = np.where(bright_specular <= _DIELECTRIC, 0, np.clip((root - b) / (2 * _DIELECTRIC), 0, 1))
    m = metallic[..., None]
    by_diffuse = diffuse * strength[..., None] / (1 - _DIELECTRIC) / np.maximum(1 - m, 1e-4)
    by_specular = (specular - _DIELECTRIC * (1 - m)) / np.maximum(m, 1e-4)
    base = np.clip(by_diffuse * (1 - m * m) + by_specular * m * m, 0, 1).astype(np.float32)
    return base, metallic.astype(np.float32)


def _clipped(value: np.ndarray | float) -> np.ndarray | float:
    if np.ndim(value) == 0:
        return float(np.clip(value, 0, 1))
    return np.ascontiguousarray(np.clip(value, 0, 1), np.float32)
