"""The pixels worth training on: those whose rays meet the object's bounds."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.errors import UserError

_CHUNK = 1 << 16


@dataclass
class RayPool:
    """Rays of many views in one axis, foreground first, both parts in the order of the views.

    Attributes:
        view: which view each ray belongs to; int32, as there are many.
        pixel: row * width + column; int32.
        near, far: the stretch of the ray inside the bounds.
        num_foreground: rays [0, num_foreground) are covered.
    """

    view: Int[Tensor, " rays"]
    pixel: Int[Tensor, " rays"]
    near: Float[Tensor, " rays"]
    far: Float[Tensor, " rays"]
    num_foreground: int
    cameras: Cameras

    def __len__(self) -> int:
        return len(self.view)

    def draw(self, num_rays: int, generator: torch.Generator, foreground_share: float = 0.75) -> Int[Tensor, " batch"]:
        """Random rays, a fixed share of them foreground where there are both kinds."""
        num_background = len(self) - self.num_foreground
        num_chosen = num_rays if not num_background else math.ceil(num_rays * foreground_share)
        if not self.num_foreground:
            num_chosen = 0
        device = self.view.device
        inside = torch.randint(max(self.num_foreground, 1), (num_chosen,), generator=generator, device=device)
        outside = torch.randint(max(num_background, 1), (num_rays - num_chosen,), generator=generator, device=device)
        return torch.cat([inside, self.num_foreground + outside])

    def foreground_subset(self, max_rays: int, generator: torch.Generator) -> "RayPool":
        """The foreground rays, or a random `max_rays` of them (in order) where there are more."""
        device = self.view.device
        order = torch.randperm(self.num_foreground, generator=generator, device=device)
        chosen = order[:max_rays].sort().values
        parts = (self.view[chosen], self.pixel[chosen], self.near[chosen], self.far[chosen])
        return RayPool(*parts, len(chosen), self.cameras)

    def values(self, images: Iterable[np.ndarray]) -> Tensor:
        """Values of images [height, width, ...] at the rays' pixels: [rays, ...].

        Args:
            images: one of every view; they may be made one at a time.
        """
        views, pixel = self.view.cpu().numpy(), self.pixel.cpu().numpy()
        parts = (0, views[: self.num_foreground]), (self.num_foreground, views[self.num_foreground :])
        result = np.empty(0, np.float32)
        for view, image in enumerate(images):
            flat = image.reshape(-1, *image.shape[2:])
            if not view:
                result = np.empty((len(self), *flat.shape[1:]), flat.dtype)
            for first, part in parts:
                start, end = first + np.searchsorted(part, [view, view + 1])
                result[start:end] = flat[pixel[start:end]]
        return torch.from_numpy(result).to(self.view.device)

    def rays(
        self, index: Int[Tensor, " batch"]
    ) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch 3"], Float[Tensor, " batch"], Float[Tensor, " batch"]]:
        """Origins, unit directions, near, far."""
        origins, directions = pixel_rays(self.cameras, self.view[index].long(), self.pixel[index].long())
        return origins, directions, self.near[index], self.far[index]


def pixel_rays(
    cameras: Cameras, view: Int[Tensor, " rays"], pixel: Int[Tensor, " rays"]
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
    """Origins and directions through pixel centres, pixels counted along rows."""
    column, row = pixel % cameras.width, pixel // cameras.width
    return cameras.rays(view, torch.stack([column, row], -1).float() + 0.5)


def gather_rays(
    cameras: Cameras,
    alpha: Iterable[np.ndarray],
    cells: OccupiedCells,
    device: torch.device | str = "cpu",
    least_coverage: float = 0.0,
) -> RayPool:
    """All pixels whose rays meet occupied cells.

    Args:
        alpha: float32 [height, width] of every view; only says which rays are foreground and which are too far from it.
        least_coverage: foreground is what has more.

    Raises:
        UserError: no ray meets the bounds.
    """
    margin = math.ceil(3 * cameras.width / cells.cells.shape[0]) + 2
    covered: list[tuple[Tensor, ...]] = []
    beside: list[tuple[Tensor, ...]] = []
    for view, image in enumerate(alpha):
        candidates = np.flatnonzero(ndimage.distance_transform_edt(image <= 0) <= margin)
        for chunk in np.array_split(candidates, max(1, math.ceil(len(candidates) / _CHUNK))):
            pixel = torch.from_numpy(chunk).to(device)
            index = torch.full_like(pixel, view)
            near, far = cells.clip(*pixel_rays(cameras, index, pixel))
            is_covered = torch.from_numpy(image.reshape(-1)[chunk] > least_coverage).to(device)
            for kept, rays in ((is_covered, covered), (~is_covered, beside)):
                kept = kept & (far > near)
                rays.append((index[kept].int(), pixel[kept].int(), near[kept], far[kept]))
    views, pixels, nears, fars = (torch.cat(parts) for parts in zip(*covered, *beside, strict=True))
    if not len(views):
        raise UserError("no camera ray meets the object's bounds", fix="check the capture's cameras and scale")
    return RayPool(views, pixels, nears, fars, sum(len(rays[0]) for rays in covered), cameras)
