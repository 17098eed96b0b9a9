"""OBJ's material libraries: Phong's numbers as metallic-roughness values.

Kd, map_Kd            base colour; Kd is linear, as Blender writes and reads it; the map is sRGB coded and
                      multiplied (a black Kd beside a map means "none" to many exporters and counts as white)
Ns                    highlight exponent: alpha = sqrt(2 / (Ns + 2)), the GGX lobe as wide as Blinn's, and
                      roughness = sqrt(alpha). A black Ks, or illum 0 or 1, means no highlight: roughness 1
Pr, Pm, map_Pr, map_Pm, norm  the physically based extension, used as it stands
bsdf pbr              as NVDiffRec writes it: map_Ks holds roughness in green and metalness in blue
d, Tr, map_d          opacity; anything below 250/255 is (semi-)transparent
map_Bump, bump        used where the picture looks like tangent-space normals; heights are left out
Ka, Ks, Ke, ...       left out; Phong's specular colour has no counterpart but metals, which it was seldom meant for
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.object_textures import decoded
from illuminerf.cues.raw_objects import ImageFile, RawMaterial, ReadingLimits, file_beside

# options of map_ statements and how many values follow each
_OPTIONS = {"-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-bm": 1, "-boost": 1,
            "-mm": 2, "-type": 1, "-o": 3, "-s": 3, "-t": 3}  # fmt: skip
_DEFAULT_ROUGHNESS = 0.5
_MAX_BUMP_MEGAPIXELS = 64.0


def read_mtl(model: Path, library: Path, limits: ReadingLimits) -> dict[str, RawMaterial]:
    """All materials of `library`, whose textures must lie in the folder of `model`.

    Raises:
        BrokenObject: it makes no sense, or a texture is missing.
        OSError: it or a texture cannot be opened or read.
    """
    limits.check_file(library)
    found: dict[str, dict[str, list[str]]] = {}
    statements: dict[str, list[str]] | None = None
    for line in library.read_text("utf-8", "replace").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] == "newmtl":
            statements = found.setdefault(line.split(None, 1)[1].strip() if len(words) > 1 else "", {})
        elif statements is not None:
            statements[words[0].lower()] = words[1:]
    images: dict[Path, ImageFile] = {}
    materials = {}
    for name, lines in found.items():
        try:
            materials[name] = _material(model, library, lines, images, limits)
        except (ValueError, IndexError) as error:
            raise BrokenObject(
                "unreadable", f"{library.name} has a broken material {name!r}", got=str(error)
            ) from error
    return materials


def _material(
    model: Path, library: Path, lines: dict[str, list[str]], images: dict[Path, ImageFile], limits: ReadingLimits
) -> RawMaterial:
    def image(*keys: str) -> ImageFile | None:
        key = next((key for key in keys if lines.get(key)), None)
        return None if key is None else _image(model, library, lines[key], images, limits)

    def number(key: str) -> float | None:
        return _finite(lines[key][0]) if lines.get(key) else None

    color_image = image("map_kd", "map_ka")
    color = _color(lines.get("kd"))
    if color_image is not None and color is not None and max(color) == 0:
        color = None
    opacity = number("d")
    if opacity is None:
        opacity = 1.0 - (number("tr") or 0.0)
    rough, metal = image("map_pr"), image("map_pm")
    packs = lines.get("bsdf") == ["pbr"] and bool(lines.get("map_ks")) and rough is None and metal is None
    if packs:
        rough = metal = image("map_ks")
    roughness = 1.0 if rough is not None else number("pr")
    metallic = 1.0 if metal is not None else number("pm")
    normal = image("norm", "map_kn")
    bump = None if normal is not None else image("map_bump", "bump")
    if bump is not None and _looks_like_normals(bump, limits):
        normal = bump
    if roughness is None and ({"ns", "illum", "ks"} & set(lines) or color is not None or color_image is not None):
        exponent = float(lines["ns"][0]) if lines.get("ns") else None
        roughness = _phong_roughness(lines, exponent, number("illum"))
    return RawMaterial(
        color=color,
        color_image=color_image,
        alpha=opacity,
        alpha_cutoff=None if opacity < 1 or "map_d" in lines else -1.0,
        alpha_image=image("map_d"),
        roughness=None if roughness is None else float(np.clip(roughness, 0, 1)),
        metallic=None if metallic is None else float(np.clip(metallic, 0, 1)),
        roughness_image=rough,
        metallic_image=metal,
        roughness_channel=1 if packs else 0,
        metallic_channel=2 if packs else 0,
        normal_image=normal,
        normal_scale=1.0 if normal is None else _bump_multiplier(lines),
    )


def _phong_roughness(lines: dict[str, list[str]], exponent: float | None, illumination: float | None) -> float:
    specular = _color(lines.get("ks"))
    if illumination in (0, 1) or (specular is not None and max(specular) == 0):
        return 1.0
    if exponent is None or not np.isfinite(exponent):
        return _DEFAULT_ROUGHNESS
    return float((2 / (max(exponent, 0.0) + 2)) ** 0.25)


def _bump_multiplier(lines: dict[str, list[str]]) -> float:
    words: list[Any] = next((lines[key] for key in ("norm", "map_kn", "map_bump", "bump") if lines.get(key)), [])
    return _finite(words[words.index("-bm") + 1]) if "-bm" in words else 1.0


def _finite(word: str) -> float:
    value = float(word)
    if not np.isfinite(value):
        raise ValueError(f"{word}, which is not finite")
    return value


def _color(words: list[str] | None) -> tuple[float, float, float] | None:
    if not words or words[0] in ("spectral", "xyz"):
        return None
    values = [float(np.clip(float(word), 0, 1)) for word in words[:3]]
    if not np.isfinite(values).all():
        raise ValueError("a colour that is not finite")
    return (values[0], values[0], values[0]) if len(values) < 3 else (values[0], values[1], values[2])


def _image(
    model: Path, library: Path, words: list[str], images: dict[Path, ImageFile], limits: ReadingLimits
) -> ImageFile:
    start = 0
    while start < len(words) and words[start] in _OPTIONS:
        following = words[start + 1 : start + 1 + _OPTIONS[words[start]]]
        # -o, -s and -t may have fewer than three numbers
        is_number = [_is_number(word) for word in following]
        start += 1 + (is_number.index(False) if _OPTIONS[words[start]] == 3 and False in is_number else len(following))
    name = " ".join(words[start:])
    name = name.replace("\\", "/")
    if name.startswith("/") or name[1:2] == ":":
        name = name.rsplit("/", 1)[-1]  # a path on the exporter's machine: only its last part can mean anything here
    file = file_beside(model, str(library.parent.resolve() / name))
    if file not in images:
        limits.check_file(file)
        images[file] = ImageFile(file.name, file.read_bytes())
    return images[file]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _looks_like_normals(image: ImageFile, limits: ReadingLimits) -> bool:
    """Whether a picture is bluish as tangent-space normals are (z near 1, x and y about 0), not grey as heights."""
    megapixels = min(limits.max_image_megapixels, _MAX_BUMP_MEGAPIXELS)
    try:
        pixels = decoded(image, replace(limits, max_image_megapixels=megapixels))
    except BrokenObject:  # it would be left out anyway
        return False
    red, green, blue = pixels[..., :3].mean((0, 1))
    return bool(blue > 170 and abs(red - 128) < 40 and abs(green - 128) < 40)
