"""What a rendered surface is made of: metallic-roughness materials as glTF means them."""

from dataclasses import dataclass

import numpy as np

from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class Material:
    """Constant, per-vertex or textured base colour, roughness and metallicity (Disney's principled model).

    Attributes:
        base_color: linear rec.709 in [0, 1]: [3], per vertex [V, 3], or an image [h, w, 3] with `uv`.
        roughness: in [0, 1], alpha = roughness^2: a number, per vertex [V], or an image [h, w].
        metallic: in [0, 1]: a number, per vertex [V], or an image [h, w].
        uv: float32 [V, 2], v = 0 at the bottom row of the images; only with images.
        normal_map: image [h, w, 3] of the same size of unit shading normals in the tangent frame (x along +u, y along
            +v, that is OpenGL's "green up", z outward), or None. Only with images.
    """

    base_color: np.ndarray | tuple[float, float, float] = (0.8, 0.8, 0.8)
    roughness: np.ndarray | float = 0.5
    metallic: np.ndarray | float = 0.0
    uv: np.ndarray | None = None
    normal_map: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name, value in (
            ("base_color", self.base_color),
            ("roughness", self.roughness),
            ("metallic", self.metallic),
        ):
            array = np.asarray(value, np.float32)
            if not np.isfinite(array).all() or array.min() < 0 or array.max() > 1:
                raise UserError(f"a material's {name} is out of range", wanted="values in [0, 1]")
        if (self.uv is None) == self.is_textured:
            raise UserError("a material needs uv coordinates exactly where it has images")
        if self.normal_map is not None and self.normal_map.shape != np.asarray(self.base_color).shape:
            raise UserError(
                "a normal map needs the size of the base colour's image",
                got=str(self.normal_map.shape),
                wanted=str(np.asarray(self.base_color).shape),
            )

    @property
    def is_textured(self) -> bool:
        """Whether the base colour is an image (roughness and metallic then are images of the same size, or numbers)."""
        return np.asarray(self.base_color).ndim == 3

    def per_vertex(self, num_vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Base colour [V, 3], roughness [V, 1], metallic [V, 1] of an untextured material."""
        color = np.broadcast_to(np.asarray(self.base_color, np.float32), (num_vertices, 3))
        scalars = (
            np.broadcast_to(np.asarray(value, np.float32), (num_vertices,))[:, None]
            for value in (self.roughness, self.metallic)
        )
        return (color, *scalars)  # type: ignore[return-value]

    def images(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Base colour [h, w, 3], roughness [h, w, 1], metallic [h, w, 1] of a textured material."""
        color = np.asarray(self.base_color, np.float32)
        scalars = (
            np.broadcast_to(np.asarray(value, np.float32), color.shape[:2])[..., None]
            for value in (self.roughness, self.metallic)
        )
        return (color, *scalars)  # type: ignore[return-value]


Parts = list[tuple[TriangleMesh, Material]]
"""An object: meshes in one frame, each with its material."""
