"""glTF's materials: metallic-roughness, the older specular-glossiness, and what lets light through.

Left out: emission, baked occlusion, clearcoat, sheen, anisotropy; they have no place in the metallic-roughness model
that targets and cues share.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from illuminerf.cues.gltf_document import GltfDocument
from illuminerf.cues.raw_objects import ImageFile, RawMaterial

_CLAMP_TO_EDGE = 33071
_LIGHT_PASSES = ("KHR_materials_transmission", "KHR_materials_diffuse_transmission")
_TRANSMISSION_FACTORS = ("transmissionFactor", "diffuseTransmissionFactor")
_IMAGE_EXTENSIONS = ("EXT_texture_webp", "KHR_texture_basisu", "MSFT_texture_dds")


@dataclass(frozen=True)
class TextureCoordinates:
    """Which coordinates a material's textures use, and how they are moved (KHR_texture_transform).

    Attributes:
        uv_set: the number of TEXCOORD_n.
        offset, scale, rotation: applied as offset + R(rotation) (scale * uv), radians, in glTF's top-down v.
    """

    uv_set: int = 0
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    rotation: float = 0.0

    def bottom_up(self, uv: np.ndarray) -> np.ndarray:
        """Move glTF's coordinates [V, 2] and turn them so that v = 0 is at the bottom row."""
        cosine, sine = np.cos(self.rotation), np.sin(self.rotation)
        turn = np.array([[cosine, sine], [-sine, cosine]])
        moved = (np.nan_to_num(uv, posinf=0, neginf=0) * self.scale) @ turn.T + self.offset
        return np.stack([moved[:, 0], 1 - moved[:, 1]], -1)


class GltfMaterials:
    """The materials of a document, each made once, so that parts that share one share its textures."""

    def __init__(self, document: GltfDocument) -> None:
        self._document = document
        self._made: dict[int, tuple[RawMaterial, TextureCoordinates]] = {}

    def material(self, index: Any) -> tuple[RawMaterial | None, TextureCoordinates]:
        """Material `index` (None: none) and the coordinates of its textures."""
        if index is None:
            return None, TextureCoordinates()
        entry = self._document.item("materials", index)
        if index not in self._made:
            try:
                self._made[index] = self._read(entry)
            except (TypeError, ValueError, KeyError, AttributeError) as error:
                raise self._document.broken(f"a broken material {index}: {error}") from error
        return self._made[index]

    def _read(self, entry: dict[str, Any]) -> tuple[RawMaterial, TextureCoordinates]:
        extensions = entry.get("extensions", {})
        old = extensions.get("KHR_materials_pbrSpecularGlossiness")
        pbr = entry.get("pbrMetallicRoughness", {})
        infos = (
            {"color": old.get("diffuseTexture"), "specular": old.get("specularGlossinessTexture")}
            if old is not None
            else {"color": pbr.get("baseColorTexture"), "lobe": pbr.get("metallicRoughnessTexture")}
        )
        infos["normal"] = entry.get("normalTexture")
        coordinates = next((self._coordinates(info) for info in infos.values() if info), TextureCoordinates())
        # one mesh has one set of coordinates: images laid out by another are left out (their factors stay)
        images = {
            name: self._image(info) for name, info in infos.items() if info and self._coordinates(info) == coordinates
        }
        factor = (old or {}).get("diffuseFactor") if old is not None else pbr.get("baseColorFactor")
        alpha = 1.0 if factor is None or len(factor) < 4 else _finite(factor[3], 1.0)
        material = RawMaterial(
            color=None if factor is None else _clipped_color(factor),
            color_image=images.get("color"),
            alpha=alpha,
            alpha_cutoff=_alpha_cutoff(entry),
            transmits=_transmits(extensions),
            normal_image=images.get("normal"),
            normal_scale=_finite((entry.get("normalTexture") or {}).get("scale", 1.0), 1.0),
            wraps=all(self._wraps(info) for info in infos.values() if info),
        )
        if old is not None:
            return replace(
                material,
                specular=_clipped_color(old.get("specularFactor", [1, 1, 1])),
                glossiness=_unit(old.get("glossinessFactor", 1.0)),
                specular_image=images.get("specular"),
            ), coordinates
        return replace(material, **_lobe(entry, pbr, images.get("lobe"))), coordinates

    def _coordinates(self, info: dict[str, Any]) -> TextureCoordinates:
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        offset, scale = moved.get("offset", (0, 0)), moved.get("scale", (1, 1))
        return TextureCoordinates(
            int(moved.get("texCoord", info.get("texCoord", 0))),
            (float(offset[0]), float(offset[1])),
            (float(scale[0]), float(scale[1])),
            float(moved.get("rotation", 0.0)),
        )

    def _image(self, info: dict[str, Any]) -> ImageFile:
        texture = self._document.item("textures", info.get("index"))
        extensions = texture.get("extensions", {})
        if "source" not in texture:
            name = next((name for name in _IMAGE_EXTENSIONS if name in extensions), None)
            if name is None:
                raise self._document.broken("a texture without an image")
            if name == "KHR_texture_basisu":
                raise self._document.broken(f"the extension {name}, which is not supported")
            return self._document.image(extensions[name].get("source"))
        return self._document.image(texture["source"])

    def _wraps(self, info: dict[str, Any]) -> bool:
        texture = self._document.item("textures", info.get("index"))
        if "sampler" not in texture:
            return True
        sampler = self._document.item("samplers", texture["sampler"])
        return _CLAMP_TO_EDGE not in (sampler.get("wrapS"), sampler.get("wrapT"))


def _lobe(entry: dict[str, Any], pbr: dict[str, Any], image: ImageFile | None) -> dict[str, Any]:
    """Roughness and metallicity; 1 and 1 where a described material leaves them out, as the standard says."""
    if "KHR_materials_unlit" in entry.get("extensions", {}):
        # its picture is meant to be seen as it is, which a rough dielectric comes nearest to
        return {"roughness": 1.0, "metallic": 0.0}
    given = {key: pbr[key] for key in ("roughnessFactor", "metallicFactor") if key in pbr}
    if not given and image is None and "baseColorTexture" not in pbr and "baseColorFactor" not in pbr:
        return {}
    return {
        "roughness": _unit(pbr.get("roughnessFactor", 1.0)),
        "metallic": _unit(pbr.get("metallicFactor", 1.0)),
        "roughness_image": image,
        "metallic_image": image,
        "roughness_channel": 1,
        "metallic_channel": 2,
    }


def _alpha_cutoff(entry: dict[str, Any]) -> float | None:
    """As `RawMaterial.alpha_cutoff`."""
    match entry.get("alphaMode", "OPAQUE"):
        case "BLEND":
            return None
        case "MASK":
            return _finite(entry.get("alphaCutoff", 0.5), 0.5)
        case _:
            return -1.0


def _transmits(extensions: dict[str, Any]) -> bool:
    found = [extensions.get(name) for name in _LIGHT_PASSES]
    return any(
        float(extension.get(factor, 0.0)) > 0
        for extension, factor in zip(found, _TRANSMISSION_FACTORS, strict=True)
        if extension is not None
    )


def _finite(value: Any, default: float) -> float:
    number = float(value)
    return number if np.isfinite(number) else default


def _unit(value: Any) -> float:
    return float(np.clip(_finite(value, 1.0), 0, 1))


def _clipped_color(factor: Any) -> tuple[float, float, float]:
    return _unit(factor[0]), _unit(factor[1]), _unit(factor[2])
