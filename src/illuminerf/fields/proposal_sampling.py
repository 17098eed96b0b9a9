"""One round of proposal sampling (mip-NeRF 360): a cheap density says where the surface field looks.

Deviation: along a ray, edges are spaced evenly in distance between the near and far ends of the object's bounds;
the unbounded contraction is not needed, because captures are scaled into the unit ball and masked.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from illuminerf.fields.hash_grid import HashGrid, HashGridConfig
from illuminerf.fields.step_draws import StepDraws


@dataclass(frozen=True)
class ProposalConfig:
    """The proposal density."""

    grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(5, 2, 14, 16, 128))
    """Its hash grid."""
    hidden_width: int = 16
    """Width of its one hidden layer."""


class ProposalField(nn.Module):
    """Density [points] per unit length at positions [points, 3]."""

    def __init__(self, config: ProposalConfig) -> None:
        super().__init__()
        self.grid = HashGrid(config.grid)
        self.mlp = nn.Sequential(
            nn.Linear(config.grid.width, config.hidden_width), nn.ReLU(), nn.Linear(config.hidden_width, 1)
        )

    def forward(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        """Non-negative density; about 3 per unit before training, so that rays start half transparent."""
        return functional.softplus(self.mlp(self.grid(positions))[..., 0] + 3.0)


def uniform_edges(
    near: Float[Tensor, " rays"],
    far: Float[Tensor, " rays"],
    num_samples: int,
    draws: StepDraws | None,
) -> Float[Tensor, "rays edges"]:
    """Edges of `num_samples` even intervals; inner edges are jittered by up to half an interval with draws."""
    fractions = torch.linspace(0, 1, num_samples + 1, device=near.device).expand(len(near), -1)
    if draws is not None:
        jitter = draws.uniform(num_samples - 1) - 0.5
        fractions = fractions + functional.pad(jitter / num_samples, (1, 1))
    return near[:, None] + (far - near)[:, None] * fractions


def resample_edges(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays samples"],
    num_samples: int,
    draws: StepDraws | None,
    floor: float = 0.01,
) -> Float[Tensor, "rays new_edges"]:
    """Edges of `num_samples` intervals that split the mass of the histogram evenly (inverse CDF).

    Args:
        edges: edges of the histogram, increasing.
        weights: its mass per interval; need not sum to one.
        num_samples: how many intervals come out.
        draws: jitter the split points inside their strata; None takes the middles.
        floor: mass spread evenly over the ray beforehand, as a share of one.
    """
    mass = weights.detach() + floor * (edges[:, 1:] - edges[:, :-1]) / (edges[:, -1:] - edges[:, :1])
    cdf = functional.pad(torch.cumsum(mass, -1), (1, 0))
    cdf = cdf / cdf[:, -1:]
    count = num_samples + 1
    strata = torch.arange(count, device=edges.device, dtype=edges.dtype).expand(len(edges), -1)
    targets = strata / num_samples if draws is None else (strata + draws.uniform(count)) / count
    targets = targets.contiguous()
    above = torch.searchsorted(cdf.contiguous(), targets, right=True).clamp(1, edges.shape[1] - 1)
    low, high = cdf.gather(1, above - 1), cdf.gather(1, above)
    share = ((targets - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
    left, right = edges.gather(1, above - 1), edges.gather(1, above)
    return left + share * (right - left)


def interlevel_loss(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays samples"],
    proposal_edges: Float[Tensor, "rays proposal_edges"],
    proposal_weights: Float[Tensor, "rays proposal_samples"],
) -> Float[Tensor, ""]:
    """mip-NeRF 360, equation 13: how much the fine weights exceed what the proposal histogram allows.

    Only the proposal gets a gradient. Mean over rays of the sum over samples.
    """
    edges, weights = edges.detach(), weights.detach()
    cumulative = functional.pad(torch.cumsum(proposal_weights, -1), (1, 0))
    last = proposal_edges.shape[1] - 1
    starts = torch.searchsorted(proposal_edges, edges[:, :-1].contiguous(), right=True) - 1
    ends = torch.searchsorted(proposal_edges, edges[:, 1:].contiguous(), right=False)
    bound = cumulative.gather(1, ends.clamp(0, last)) - cumulative.gather(1, starts.clamp(0, last))
    excess = (weights - bound).clamp_min(0)
    return (excess**2 / (weights + 1e-5)).sum(-1).mean()
