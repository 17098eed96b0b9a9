"""Rays are drawn where the error is, from all rays and from nowhere else."""

import numpy as np
import torch

from illuminerf.fields.bounds import OccupiedCells, visual_hull
from illuminerf.fields.ray_guide import RayGuide
from illuminerf.fields.ray_pool import RayPool, gather_rays
from tests.fields.sphere_views import sphere_views


def pool() -> RayPool:
    cameras, masks = sphere_views(0.5, num_views=4)
    return gather_rays(cameras, masks, OccupiedCells(visual_hull(cameras, masks, 32)).dilated(1))


def drawn(guide: RayGuide, seed: int = 0) -> torch.Tensor:
    return guide.draw(20_000, torch.Generator().manual_seed(seed))


def test_before_anything_is_known_every_ray_is_as_likely() -> None:
    rays = pool()
    counts = torch.bincount(drawn(RayGuide(rays)), minlength=len(rays)).double()
    assert len(counts) == len(rays)
    expected = 20_000 / len(rays)
    assert abs(float(((counts - expected) ** 2).mean()) / expected - 1) < 0.1  # as of a Poisson distribution


def test_draws_follow_the_error() -> None:
    rays = pool()
    guide = RayGuide(rays)
    everything = torch.arange(len(rays))
    is_wrong = (rays.view == 2) & (rays.pixel // rays.cameras.width < 24)  # three whole rows of tiles
    for _ in range(20):
        guide.update(everything, torch.where(is_wrong, 0.3, 0.1))
    wanted = float(0.3 * is_wrong.sum() / (0.3 * is_wrong.sum() + 0.1 * (~is_wrong).sum()))
    assert abs(float(is_wrong[drawn(guide)].double().mean()) - wanted) < 0.01
    even = float(is_wrong[drawn(RayGuide(rays))].double().mean())
    assert wanted - even > 0.1  # what the tolerance would notice
    assert torch.equal(drawn(guide), drawn(guide)) and not torch.equal(drawn(guide), drawn(guide, 1))


def test_what_is_seen_changes_and_nothing_else() -> None:
    rays = pool()
    guide = RayGuide(rays)
    guide.update(torch.tensor([5, 5, 5]), torch.tensor([0.2, 0.2, 0.2]))
    changed = np.flatnonzero(guide.errors.numpy() != 1)
    assert len(changed) == 1 and abs(float(guide.errors[int(changed[0])]) - 0.6) < 1e-6
