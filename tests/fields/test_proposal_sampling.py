"""Resampling and the interlevel loss by hand."""

import torch

from illuminerf.fields.proposal_sampling import interlevel_loss, resample_edges, uniform_edges
from illuminerf.fields.step_draws import StepDraws


def test_uniform_edges_span_the_ray_in_order() -> None:
    near, far = torch.tensor([1.0, 2.0]), torch.tensor([2.0, 2.5])
    torch.testing.assert_close(uniform_edges(near, far, 4, None)[0], torch.linspace(1, 2, 5))
    edges = uniform_edges(near, far, 16, StepDraws(torch.Generator().manual_seed(0), len(near)))
    assert bool((edges[:, 1:] > edges[:, :-1]).all())
    torch.testing.assert_close(edges[:, 0], near)
    torch.testing.assert_close(edges[:, -1], far)


def test_flat_histogram_gives_even_edges() -> None:
    edges = torch.linspace(0, 1, 9)[None]
    new = resample_edges(edges, torch.full((1, 8), 0.1), 4, None)
    torch.testing.assert_close(new, torch.linspace(0, 1, 5)[None])


def test_samples_go_where_the_weight_is() -> None:
    edges = torch.linspace(0, 1, 11).expand(200, -1).contiguous()
    weights = torch.zeros(200, 10)
    weights[:, 6] = 1.0
    new = resample_edges(edges, weights, 8, StepDraws(torch.Generator().manual_seed(0), len(edges)))
    middles = 0.5 * (new[:, 1:] + new[:, :-1])
    inside = ((middles > 0.6) & (middles < 0.7)).float().mean()
    assert inside > 0.9
    spread = resample_edges(edges, torch.ones(200, 10), 8, StepDraws(torch.Generator().manual_seed(0), len(edges)))
    middles = 0.5 * (spread[:, 1:] + spread[:, :-1])
    assert ((middles > 0.6) & (middles < 0.7)).float().mean() < 0.3


def test_interlevel_loss_is_zero_for_an_upper_bound_and_not_below() -> None:
    edges = torch.tensor([[0.0, 0.25, 0.5, 0.75, 1.0]])
    coarse = torch.tensor([[0.0, 0.5, 1.0]])
    weights = torch.tensor([[0.1, 0.3, 0.2, 0.1]])
    assert float(interlevel_loss(edges, weights, coarse, torch.tensor([[0.5, 0.4]]))) == 0
    short = torch.tensor([[0.05, 0.4]], requires_grad=True)
    loss = interlevel_loss(edges, weights, coarse, short)
    torch.testing.assert_close(loss, torch.tensor(0.05**2 / 0.1 + 0.25**2 / 0.3), rtol=1e-3, atol=0)
    loss.backward()
    assert float(short.grad[0, 0]) < 0 and float(short.grad[0, 1]) == 0


def test_interlevel_loss_counts_every_bin_that_overlaps() -> None:
    coarse = torch.tensor([[0.0, 0.5, 1.0]])
    across = torch.tensor([[0.0, 0.4, 0.6, 1.0]])
    weights = torch.tensor([[0.0, 0.5, 0.0]])
    assert float(interlevel_loss(across, weights, coarse, torch.tensor([[0.25, 0.25]]))) == 0
    assert float(interlevel_loss(across, weights, coarse, torch.tensor([[0.25, 0.0]]))) > 0


def test_interlevel_loss_leaves_fine_weights_alone() -> None:
    edges = torch.tensor([[0.0, 0.5, 1.0]])
    fine = torch.tensor([[0.9, 0.1]], requires_grad=True)
    coarse = torch.tensor([[0.1, 0.1]], requires_grad=True)
    interlevel_loss(edges, fine, edges, coarse).backward()
    assert fine.grad is None and coarse.grad is not None
