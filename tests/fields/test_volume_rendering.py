"""Density, optical depth and weights against closed forms."""

import math

import torch

from illuminerf.fields.volume_rendering import (
    composite_samples,
    laplace_density,
    optical_depth,
    rendering_weights,
)

_BETA = torch.tensor(0.05, dtype=torch.float64)


def test_density_is_half_its_maximum_on_the_surface() -> None:
    distance = torch.tensor([-10.0, 0.0, 10.0], dtype=torch.float64)
    torch.testing.assert_close(
        laplace_density(distance, _BETA) * _BETA, torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
    )


def test_optical_depth_is_the_integral_of_the_density() -> None:
    distance = torch.linspace(-0.3, 0.3, 13, dtype=torch.float64)
    for slope in (-1.0, -0.2, 1e-4, 0.0, 0.7):
        width = torch.full_like(distance, 0.21)
        ours = optical_depth(distance, torch.full_like(distance, slope), width, _BETA)
        fine = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000 - 0.5
        along = distance[:, None] + slope * 0.21 * fine
        wanted = laplace_density(along, _BETA).mean(-1) * 0.21
        torch.testing.assert_close(ours, wanted, rtol=1e-3, atol=1e-7)


def test_optical_depth_splits() -> None:
    """An interval's depth is the sum of its halves', which the midpoint rule misses."""
    slope = torch.tensor([-0.8], dtype=torch.float64)
    width = torch.tensor([0.4], dtype=torch.float64)
    middle = torch.tensor([0.03], dtype=torch.float64)
    whole = optical_depth(middle, slope, width, _BETA)
    halves = [optical_depth(middle + side * slope * width / 4, slope, width / 2, _BETA) for side in (-1, 1)]
    torch.testing.assert_close(whole, halves[0] + halves[1], rtol=1e-10, atol=0)
    midpoint = [laplace_density(middle + side * slope * width / 4, _BETA) * width / 2 for side in (-1, 1)]
    assert (midpoint[0] + midpoint[1] - whole).abs() > 0.05 * whole


def test_optical_depth_gradcheck() -> None:
    generator = torch.Generator().manual_seed(0)
    distance = (torch.rand(20, generator=generator, dtype=torch.float64) - 0.5).requires_grad_()
    slope = (torch.rand(20, generator=generator, dtype=torch.float64) * 2 - 1).requires_grad_()
    width = torch.full((20,), 0.2, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda d, s, b: optical_depth(d, s, width, b), (distance, slope, _BETA.clone().requires_grad_())
    )


def test_float32_stays_finite_at_extremes() -> None:
    for beta in (5e-4, 1e-3, 1.0):
        distance = torch.linspace(-1, 1, 101).requires_grad_()
        slope = torch.linspace(-2, 2, 101).requires_grad_()
        depth = optical_depth(distance, slope, torch.full((101,), 0.05), torch.tensor(beta))
        assert bool((depth >= -1e-6).all())
        weights = rendering_weights(depth[None])
        (weights * torch.linspace(0, 1, 101)).sum().backward()
        assert bool(torch.isfinite(distance.grad).all()) and bool(torch.isfinite(slope.grad).all())


def test_constant_slab() -> None:
    """Density 2 over length 1.5: opacity 1 - exp(-3) however it is cut."""
    for count in (1, 7, 100):
        depths = torch.full((1, count), 3.0 / count, dtype=torch.float64)
        weights = rendering_weights(depths)
        assert math.isclose(float(weights.sum()), 1 - math.exp(-3), rel_tol=1e-12)
        colour = composite_samples(weights, torch.full((1, count, 3), 0.4, dtype=torch.float64))
        torch.testing.assert_close(colour, torch.full((1, 3), 0.4 * (1 - math.exp(-3)), dtype=torch.float64))


def test_an_opaque_sample_hides_what_is_behind() -> None:
    weights = rendering_weights(torch.tensor([[0.0, 80.0, 5.0]]))
    torch.testing.assert_close(weights, torch.tensor([[0.0, 1.0, 0.0]]))
