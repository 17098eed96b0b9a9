"""Images with their cameras."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.errors import UserError


def spread_evenly(count: int, most: int) -> list[int]:
    """At most so many of `count` things in order, the first and the last among them."""
    return [int(number) for number in np.unique(np.linspace(0, count - 1, min(most, count)).round())]


class EightBitImages:
    """A stack of images kept as bytes, a quarter of what floats take; what is indexed comes out as float32 in [0, 1].

    Args:
        stored: uint8 [views, height, width, ...].
    """

    def __init__(self, stored: np.ndarray) -> None:
        self._stored = stored
        self.shape = stored.shape

    def __len__(self) -> int:
        return len(self._stored)

    def __getitem__(self, index: Any) -> np.ndarray:
        return self._stored[index].astype(np.float32) / 255.0

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[view] for view in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)


@dataclass(frozen=True)
class Views:
    """Posed images of one object.

    Attributes:
        cameras: one per image.
        srgb: float32 [views, height, width, 3], straight sRGB in [0, 1]; 0 where alpha is 0.
        alpha: float32 [views, height, width] coverage in [0, 1].
    """

    cameras: Cameras
    srgb: np.ndarray | EightBitImages
    alpha: np.ndarray | EightBitImages

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

    def alphas(self, views: Iterable[int] | None = None) -> Iterator[np.ndarray]:
        """Coverage, view by view: float32 [height, width]."""
        return (self.alpha[view] for view in (range(len(self)) if views is None else views))

    def premultiplied(self, views: Iterable[int] | None = None) -> Iterator[np.ndarray]:
        """sRGB values times alpha, that is over black, view by view: float32 [height, width, 3]."""
        return (
            self.srgb[view] * self.alpha[view][..., None] for view in (range(len(self)) if views is None else views)
        )
