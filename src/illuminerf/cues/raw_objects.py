"""Objects as the readers of single formats leave them: parts in the file's own frame, textures not yet decoded.

A reader turns its file into a `RawObject` of `RawPart`s; `object_files.load_object` makes meshes and materials of them.
"""

import errno
import stat
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class ReadingLimits:
    """How much of a file is read before it is called too large; checked before memory is spent."""

    max_faces: int = 2_000_000
    """Triangles of the whole object, with every instance counted."""
    max_megabytes: float = 1024.0
    """Size of the file and of each file that it names, in 2^20 bytes."""
    max_image_megapixels: float = 100.0
    """Largest texture image that is decoded, in 2^20 pixels (8192 x 8192 are 64)."""
    max_texture_side: int = 2048
    """Larger textures are averaged down to this width and height."""
    max_texels: int = 16 * 2**20
    """Texels of all textured materials of an object together (32 bytes each); where there are more, all are averaged
    down alike."""

    def __post_init__(self) -> None:
        if min(self.max_faces, self.max_megabytes, self.max_image_megapixels, self.max_texture_side) <= 0:
            raise UserError("limits of object reading must be above 0")
        if self.max_texels < 2**12:
            raise UserError("max_texels is too small", got=str(self.max_texels), wanted="4096 or more")

    def check_faces(self, name: str, num_faces: int) -> None:
        """BrokenObject "too large" where there are too many triangles."""
        if num_faces > self.max_faces:
            raise BrokenObject(
                "too large", f"{name} is too large", got=f"{num_faces:,} faces", wanted=f"at most {self.max_faces:,}"
            )

    def check_file(self, path: Path) -> None:
        """BrokenObject "too large" where a file is; OSError where it cannot be looked at."""
        self.check_bytes(path.name, path.stat().st_size)

    def check_bytes(self, name: str, size: int) -> None:
        """BrokenObject "too large" where a file of `size` bytes is."""
        if size > self.max_megabytes * 2**20:
            raise BrokenObject(
                "too large",
                f"{name} is too large",
                got=f"{size / 2**20:.0f} MB",
                wanted=f"at most {self.max_megabytes:g} MB",
            )


@dataclass(frozen=True)
class ImageFile:
    """An image still in its file format.

    Attributes:
        name: for messages.
        content: the bytes of the file.
    """

    name: str
    content: bytes = field(repr=False)


@dataclass(frozen=True)
class RawMaterial:
    """What a file says about a material; None where it says nothing.

    Attributes:
        color: linear base colour factor in [0, 1].
        color_image: base colour, sRGB coded, with alpha where it has any.
        alpha: opacity factor.
        alpha_cutoff: None: alpha blends; a number: what is less opaque is cut out (glTF's MASK); -1: alpha is ignored.
        alpha_image: opacity in its red channel, where it is not the alpha of `color_image` (OBJ's map_d).
        transmits: light passes through whatever alpha says.
        roughness, metallic: factors in [0, 1].
        roughness_image, metallic_image: multiplied with the factors, linear; read from the channel named beside.
        roughness_channel, metallic_channel: glTF packs both into one image (green and blue).
        normal_image: tangent-space normals, green up; normal_scale: multiplies their x and y.
        specular, glossiness: factors of the old specular-glossiness workflow, else None (then `color` is the diffuse
            colour); specular_image: sRGB specular, glossiness in alpha.
        wraps: False where the textures end at their edge instead of repeating.
    """

    color: tuple[float, float, float] | None = None
    color_image: ImageFile | None = None
    alpha: float = 1.0
    alpha_cutoff: float | None = -1.0
    alpha_image: ImageFile | None = None
    transmits: bool = False
    roughness: float | None = None
    metallic: float | None = None
    roughness_image: ImageFile | None = None
    metallic_image: ImageFile | None = None
    roughness_channel: int = 0
    metallic_channel: int = 0
    normal_image: ImageFile | None = None
    normal_scale: float = 1.0
    specular: tuple[float, float, float] | None = None
    glossiness: float = 1.0
    specular_image: ImageFile | None = None
    wraps: bool = True

    @property
    def has_color(self) -> bool:
        """Whether it says what colour the object has; plain white is what exporters write for "none"."""
        return self.color_image is not None or (self.color is not None and min(self.color) < 1)

    @property
    def has_lobe(self) -> bool:
        """Whether it says how the object reflects."""
        given = (self.roughness, self.metallic, self.roughness_image, self.metallic_image, self.specular)
        return any(value is not None for value in given)

    @property
    def needs_uv(self) -> bool:
        """Whether it has images."""
        images = (self.color_image, self.roughness_image, self.metallic_image, self.normal_image, self.specular_image)
        return any(image is not None for image in images)


@dataclass(frozen=True)
class RawPart:
    """Triangles of one material in the file's frame.

    Attributes:
        vertices: float64 [V, 3].
        faces: int64 [F, 3], counter-clockwise seen from outside.
        normals: float64 [V, 3], any length, or None.
        uv: float64 [V, 2], v = 0 at the bottom row of images, or None.
        colors: float32 [V, 3] linear, or None; multiplies the base colour.
        color_alpha: least alpha of the vertex colours.
        material: None where the file names none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None
    colors: np.ndarray | None = None
    color_alpha: float = 1.0
    material: RawMaterial | None = None


def file_beside(model: Path, uri: str) -> Path:
    """The file that a model names relative to itself.

    Raises:
        BrokenObject: it lies outside the model's folder ("unreadable"), or is not there ("missing texture").
        OSError: nobody can tell, since the disk does not answer or must not be read.
    """
    folder = model.parent.resolve()
    try:
        found = (folder / uri.replace("\\", "/")).resolve()
    except (OSError, ValueError, RuntimeError) as error:  # a loop of links, an embedded null
        raise BrokenObject("unreadable", f"{model.name} names a file that cannot be resolved", got=repr(uri)) from error
    if not found.is_relative_to(folder):
        raise BrokenObject(
            "unreadable",
            f"{model.name} names a file outside its own folder",
            got=repr(uri),
            wanted="a path beside the model",
        )
    if not _is_file(model, uri, found):
        raise BrokenObject(
            "missing texture",
            f"{model.name} names a file that is missing",
            got=repr(uri),
            fix="copy it beside the model",
        )
    return found


def _is_file(model: Path, uri: str, found: Path) -> bool:
    """As `Path.is_file`, but only for what the model says is the answer no."""
    try:
        return stat.S_ISREG(found.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        if error.errno not in (errno.ENAMETOOLONG, errno.ELOOP):
            raise
        raise BrokenObject("unreadable", f"{model.name} names a file that cannot be resolved", got=repr(uri)) from error
