"""Ray clipping and the visual hull."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from illuminerf.fields.bounds import (
    OccupiedCells,
    ball_interval,
    signed_distance_of_cells,
    visual_hull,
)
from illuminerf.fields.ray_pool import gather_rays
from illuminerf.workflow.errors import UserError
from tests.fields.sphere_views import sphere_views


def test_ball_interval() -> None:
    origins = torch.tensor([[0.0, 0, -3], [0.0, 2, -3], [0.0, 0, 0]])
    directions = torch.tensor([[0.0, 0, 1]]).expand(3, 3)
    near, far = ball_interval(origins, directions)
    torch.testing.assert_close(near, torch.tensor([2.0, 3.0, 0.0]))
    torch.testing.assert_close(far, torch.tensor([4.0, 3.0, 1.0]))


def test_march_kernel_equals_twin() -> None:
    generator = torch.Generator().manual_seed(0)
    cells = OccupiedCells(torch.rand(24, 24, 24, generator=generator) < 0.004)
    origins = 2.5 * functional.normalize(torch.randn(2000, 3, generator=generator), dim=-1)
    directions = functional.normalize(torch.rand(2000, 3, generator=generator) - 0.5 - origins, dim=-1)
    near, far = ball_interval(origins, directions)
    first, last = cells._march(origins, directions, near, far, 36)
    hit, width = last >= 0, (far - near) / 36
    assert 0.05 < float(hit.float().mean()) < 0.95
    ours = cells.clip(origins, directions)
    torch.testing.assert_close(ours[0], (near + width * (first - 1).clamp_min(0)) * hit)
    torch.testing.assert_close(ours[1], (near + width * (last + 2).clamp_max(36)) * hit)


def test_visual_hull_of_a_sphere_is_about_that_sphere() -> None:
    cameras, masks = sphere_views(0.5)
    hull = OccupiedCells(visual_hull(cameras, masks, 32))
    shell = functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert bool(hull.contains(0.49 * shell).all())
    assert float(hull.contains(0.75 * shell).float().mean()) < 0.02
    distance = signed_distance_of_cells(hull.cells)
    assert float(distance[16, 16, 16]) < -0.3 and float(distance[0, 16, 16]) > 0.3


def test_masks_that_contradict_the_cameras() -> None:
    cameras, masks = sphere_views(0.5)
    with pytest.raises(UserError, match="inside all masks"):
        visual_hull(cameras, np.zeros_like(masks), 16)


def test_ray_pool_holds_all_foreground_and_little_else() -> None:
    cameras, masks = sphere_views(0.5, num_views=8)
    pool = gather_rays(cameras, masks, OccupiedCells(visual_hull(cameras, masks, 32)).dilated(1))
    assert pool.num_foreground == int(masks.sum())
    assert pool.num_foreground < len(pool) < 2.5 * pool.num_foreground
    flat = torch.from_numpy(masks.reshape(8, -1))
    assert bool((flat[pool.view, pool.pixel][: pool.num_foreground] > 0).all())
    origins, directions, near, far = pool.rays(torch.arange(pool.num_foreground))
    entry, leave = ball_interval(origins, directions, 0.5)
    assert bool((near <= entry + 1e-3).all()) and bool((far >= leave - 1e-3).all())
    chosen = pool.draw(1000, torch.Generator().manual_seed(0), foreground_share=0.8)
    assert int((chosen < pool.num_foreground).sum()) == 800


def test_values_of_a_pool_are_those_of_its_pixels() -> None:
    cameras, masks = sphere_views(0.5, num_views=4)
    pool = gather_rays(cameras, masks, OccupiedCells(visual_hull(cameras, masks, 32)).dilated(1))
    images = np.random.default_rng(0).random((4, 48, 48, 3), np.float32)
    wanted = torch.from_numpy(images.reshape(4, -1, 3))[pool.view.long(), pool.pixel.long()]
    assert torch.equal(pool.values(iter(images)), wanted)
    assert not torch.equal(pool.values(images[::-1]), wanted)
    few = pool.foreground_subset(100, torch.Generator().manual_seed(0))
    alpha = few.values(image[..., 0] for image in images)
    assert torch.equal(alpha, torch.from_numpy(images.reshape(4, -1, 3))[few.view.long(), few.pixel.long(), 0])
