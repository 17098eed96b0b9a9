"""A texture atlas in which every triangle has its own place.

Two triangles share one square cell, each with `texels_per_edge + 1` texels along its legs and a margin of one texel
beyond its longest side, so that bilinear interpolation never reads a neighbour. No charts, so nothing can overlap, fold
or fail, whatever the mesh; the price is vertices that are not shared and a texture that nobody wants to paint on.
"""

from dataclasses import dataclass

import numpy as np

from illuminerf.workflow.errors import UserError

_MARGIN = 3
_LARGEST_SIDE = 16384


@dataclass(frozen=True)
class TriangleAtlas:
    """Places of `num_faces` triangles in a texture.

    Attributes:
        num_faces: triangles.
        texels_per_edge: steps between texels along the two shorter sides.
    """

    num_faces: int
    texels_per_edge: int = 2

    def __post_init__(self) -> None:
        if self.num_faces < 1 or self.texels_per_edge < 1:
            raise UserError("an atlas needs triangles and texels", got=str(self))
        if max(self.height, self.width) > _LARGEST_SIDE:
            raise UserError(
                "the texture would be too large",
                got=f"{self.width} x {self.height} for {self.num_faces} triangles",
                wanted=f"at most {_LARGEST_SIDE} a side",
                fix="fewer texels per edge, or a coarser mesh",
            )

    @property
    def cell(self) -> int:
        """Side of a cell in texels."""
        return self.texels_per_edge + _MARGIN

    @property
    def num_cells(self) -> int:
        """Cells in use; the last one may hold one triangle only."""
        return (self.num_faces + 1) // 2

    @property
    def columns(self) -> int:
        """Cells side by side."""
        return int(np.ceil(np.sqrt(self.num_cells)))

    @property
    def width(self) -> int:
        """Texels."""
        return self.columns * self.cell

    @property
    def height(self) -> int:
        """Texels."""
        return -(-self.num_cells // self.columns) * self.cell

    def corners(self) -> np.ndarray:
        """Texture coordinates of the triangles' corners, float32 [faces, 3, 2]; (0, 0) is the picture's upper left."""
        face = np.arange(self.num_faces)
        origin = np.stack(np.divmod(face // 2, self.columns)[::-1], -1) * self.cell
        legs = np.array([[0, 0], [1, 0], [0, 1]]) * self.texels_per_edge
        second = (face % 2 == 1)[:, None, None]
        local = np.where(second, self.cell - 1 - legs, legs)
        return ((origin[:, None] + local + 0.5) / [self.width, self.height]).astype(np.float32)

    def texels_of_cells(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What all texels of some cells show: the face of each, int64 [cells, side * side], and its barycentric
        coordinates, float32 [cells, side * side, 3]; those of the margin lie a little outside."""
        row, column = (axis.ravel() for axis in np.indices((self.cell, self.cell)))
        is_second = row + column > self.texels_per_edge + 2
        last = self.cell - 1
        along = np.where(is_second, last - column, column) / self.texels_per_edge
        down = np.where(is_second, last - row, row) / self.texels_per_edge
        barycentric = np.stack([1 - along - down, along, down], -1).astype(np.float32)
        face = np.minimum(2 * cells[:, None] + is_second, self.num_faces - 1)
        return face, np.broadcast_to(barycentric, (*face.shape, 3))

    def picture(self, texels: np.ndarray) -> np.ndarray:
        """Arrange values [cells, side * side, channels] of all cells as a picture [height, width, channels]."""
        channels, rows = texels.shape[-1], self.height // self.cell
        full = np.zeros((rows * self.columns, self.cell, self.cell, channels), texels.dtype)
        full[: self.num_cells] = texels.reshape(self.num_cells, self.cell, self.cell, channels)
        full = full.reshape(rows, self.columns, self.cell, self.cell, channels)
        return full.transpose(0, 2, 1, 3, 4).reshape(self.height, self.width, channels)
