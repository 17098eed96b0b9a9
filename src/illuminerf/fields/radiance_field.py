"""UniSDF put together: proposal, surface and appearance, rendered along rays."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from illuminerf.fields.appearance import AppearanceConfig, AppearanceField, blend_radiance
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.proposal_sampling import ProposalConfig, ProposalField, resample_edges, uniform_edges
from illuminerf.fields.shading_slots import ShadingSlots
from illuminerf.fields.step_draws import StepDraws
from illuminerf.fields.surface import SurfaceConfig, SurfaceField
from illuminerf.fields.volume_rendering import rendering_weights
from illuminerf.workflow.device import Precision
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class FieldConfig:
    """All sizes of one radiance field; the defaults are those of the embedded preset."""

    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    """Signed distance and predicted normals."""
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    """Radiance fields and AffineGLO."""
    proposal: ProposalConfig = field(default_factory=ProposalConfig)
    """Proposal density."""
    num_proposal_samples: int = 24
    """Samples per ray of the proposal (64 in the paper)."""
    num_samples: int = 16
    """Samples per ray of the surface (64 for the paper preset)."""
    min_weight: float = 1e-3
    """Samples of smaller rendering weight are not shaded; 0 shades all."""
    radiance_normals: Literal["density", "predicted"] = "density"
    """Which normals the radiance fields see and reflect about. Deviation: UniSDF's are the predicted ones, which can
    bend to explain a highlight without the surface; beneath them it came out dented where it shines."""
    has_proposal: bool = True
    """False: no proposal round (supplement A.1), surface samples are spaced evenly, for comparison."""

    def __post_init__(self) -> None:
        if min(self.num_proposal_samples, self.num_samples) < 2:
            raise UserError("a ray needs at least two samples", got=str(self.num_samples))
        if not 0 <= self.min_weight < 0.1:
            raise UserError("min_weight must be in [0, 0.1)", got=str(self.min_weight))

    @classmethod
    def embedded(cls) -> "FieldConfig":
        """For two CPU cores and images of about 200 x 200."""
        return cls()

    @classmethod
    def paper(cls) -> "FieldConfig":
        """The paper's sizes, where stated (supplement A.1); the rest follows camp_zipnerf."""
        grid = HashGridConfig(num_levels=10, num_features=4, log2_entries=21, coarsest=16, finest=8192)
        return cls(
            surface=SurfaceConfig(
                grid=grid,
                hidden_width=64,
                normal_grid=HashGridConfig(15, 4, 21, 32, 4096),
                normal_hidden_width=64,
                initial_beta=0.1,
            ),
            appearance=AppearanceConfig(
                grid=grid,
                bottleneck_width=256,
                hidden_width=256,
                num_hidden_layers=3,
                num_direction_octaves=4,
                latent_width=128,
                latent_hidden_width=128,
            ),
            proposal=ProposalConfig(HashGridConfig(6, 2, 19, 16, 512), 64),
            num_proposal_samples=64,
            num_samples=64,
            min_weight=1e-4,
            radiance_normals="predicted",
        )


@dataclass
class RaySamples:
    """Where rays were sampled and what the surface is there; positions carry no gradient."""

    edges: Float[Tensor, "rays edges"]
    positions: Float[Tensor, "rays samples 3"]
    weights: Float[Tensor, "rays samples"]
    depth: Float[Tensor, " rays"]
    gradients: Float[Tensor, "rays samples 3"]
    end_gradients: Float[Tensor, "rays edges 3"]
    proposal_edges: Float[Tensor, "rays proposal_edges"]
    proposal_weights: Float[Tensor, "rays proposal_samples"]


@dataclass
class ShadingPoints:
    """Samples that are worth shading, those of all rays in one axis."""

    ray: Int[Tensor, " points"]
    positions: Float[Tensor, "points 3"]
    weights: Float[Tensor, " points"]
    density_normals: Float[Tensor, "points 3"]


class RadianceField(nn.Module):
    """Proposal, surface and appearance of one object in the unit ball."""

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.config = config
        self.proposal = ProposalField(config.proposal) if config.has_proposal else None
        self.surface = SurfaceField(config.surface)
        self.appearance = AppearanceField(config.appearance)

    @contextmanager
    def computing_in(self, precision: Precision) -> Iterator[None]:
        """Inside, the layers of the radiance fields compute in this precision; all else stays float32."""
        before, self.appearance.precision = self.appearance.precision, precision
        try:
            yield
        finally:
            self.appearance.precision = before

    def sample(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        near: Float[Tensor, " rays"],
        far: Float[Tensor, " rays"],
        draws: StepDraws | None = None,
        level_weights: Float[Tensor, " levels"] | None = None,
    ) -> RaySamples:
        """Choose intervals by the proposal, evaluate the surface at their ends and weigh them.

        Args:
            draws: add jitter; None is deterministic.
        """
        if self.proposal is None:
            coarse = edges = uniform_edges(near, far, self.config.num_samples, draws)
            proposal_weights = None
        else:
            coarse = uniform_edges(near, far, self.config.num_proposal_samples, draws)
            density = self.proposal(_middles(origins, directions, coarse).view(-1, 3)).view(len(near), -1)
            proposal_weights = rendering_weights(density * (coarse[:, 1:] - coarse[:, :-1]))
            edges = resample_edges(coarse, proposal_weights, self.config.num_samples, draws)
        ends = origins[:, None] + edges[..., None] * directions[:, None]
        point = self.surface(ends.view(-1, 3), level_weights)
        distance, end_gradients = point.signed_distance.view_as(edges), point.gradient.view_as(ends)
        depths = self.surface.depths_along(distance, edges)
        share, weights = _crossing(distance)[..., None], rendering_weights(depths)
        return RaySamples(
            edges,
            torch.lerp(ends[:, :-1], ends[:, 1:], share),
            weights,
            depths.sum(-1),
            torch.lerp(end_gradients[:, :-1], end_gradients[:, 1:], share),
            end_gradients,
            coarse,
            weights.detach() if proposal_weights is None else proposal_weights,  # the proposal's loss is then 0
        )

    def worth_shading(self, samples: RaySamples, slots: ShadingSlots | None = None) -> ShadingPoints:
        """Samples above the configured weight.

        Deviation: UniSDF shades all. A sample left out counts as black, and the gradient that its colour would send
        to its (negligible) weight is dropped.

        Args:
            slots: a fixed number of points, where they have a capacity; weights of those that do not count are 0.
        """
        chosen, counts = (slots or ShadingSlots()).choose(samples.weights.detach() > self.config.min_weight)
        weights = samples.weights.reshape(-1).index_select(0, chosen)
        gradients = samples.gradients.reshape(-1, 3).index_select(0, chosen)
        return ShadingPoints(
            chosen // samples.weights.shape[1],
            samples.positions.reshape(-1, 3).index_select(0, chosen),
            weights if counts is None else weights * counts,
            functional.normalize(gradients, dim=-1, eps=1e-6),
        )

    def shade(
        self,
        points: ShadingPoints,
        normals: Float[Tensor, "points 3"],
        directions: Float[Tensor, "rays 3"],
        latents: Float[Tensor, "rays latent"] | None = None,
        level_weights: Float[Tensor, " levels"] | None = None,
    ) -> Float[Tensor, "rays 3"]:
        """Colour of rays: sRGB premultiplied on black."""
        values = self.appearance(
            points.positions,
            directions[points.ray],
            normals,
            None if latents is None else latents.index_select(0, points.ray),
            level_weights,
        )
        rendered = torch.zeros(len(directions), 7, device=values.device, dtype=values.dtype)
        return blend_radiance(rendered.index_add(0, points.ray, points.weights[:, None] * values))

    def shading_normals(self, points: ShadingPoints) -> Float[Tensor, "points 3"]:
        """Unit normals that the radiance fields see."""
        if self.config.radiance_normals == "density":
            return points.density_normals
        return self.surface.predicted_normals(points.positions)

    def shading_normals_at(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """The same of points that were not sampled along rays."""
        if self.config.radiance_normals == "density":
            return functional.normalize(self.surface(positions).gradient, dim=-1, eps=1e-6)
        return self.surface.predicted_normals(positions)


def _crossing(distance: Tensor) -> Tensor:
    """Where in its interval each sample lies, 0 to 1: where the ray enters the surface, else in the middle.

    Deviation: a sample whose interval holds the surface stands for it and is shaded on it. In the middle of its
    interval it may lie below, where no colour was ever learnt, which speckles images made with few samples.
    """
    before, after = distance.detach()[:, :-1], distance.detach()[:, 1:]
    enters = (before > 0) & (after <= 0)
    return torch.where(enters, before / (before - after).clamp_min(1e-9), 0.5)


def _middles(origins: Tensor, directions: Tensor, edges: Tensor) -> Tensor:
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    return origins[:, None] + middle[..., None] * directions[:, None]
