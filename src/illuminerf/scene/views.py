"""Images with their cameras."""

from dataclasses import dataclass

import numpy as np

from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class Views:
    """Posed images of one object.

    Attributes:
        cameras: one per image.
        srgb: float32 [views, height, width, 3], straight sRGB in [0, 1]; 0 where alpha is 0.
        alpha: float32 [views, height, width] coverage in [0, 1].
    """

    cameras: Cameras
    srgb: np.ndarray
    alpha: np.ndarray

    def __post_init__(self) -> None:
        wanted = (len(self.cameras), self.cameras.height, self.cameras.width)
        if self.srgb.shape != (*wanted, 3) or self.alpha.shape != wanted:
            raise UserError(
                "images and cameras do not fit together",
                got=f"colour {self.srgb.shape}, alpha {self.alpha.shape}",
                wanted=f"{(*wanted, 3)} and {wanted}",
            )

    def __len__(self) -> int:
        return len(self.cameras)

    def premultiplied(self) -> np.ndarray:
        """sRGB values times alpha, that is over black: float32 [views, height, width, 3]."""
        return self.srgb * self.alpha[..., None]
