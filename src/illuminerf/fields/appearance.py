"""The two radiance fields of UniSDF, the bottleneck they share, and AffineGLO on it."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from illuminerf.fields.directions import encode_directions, encoded_width, reflect
from illuminerf.fields.hash_grid import HashGrid, HashGridConfig
from illuminerf.workflow.device import Precision, autocast


@dataclass(frozen=True)
class AppearanceConfig:
    """Colour as a function of position, direction, normal and latent code."""

    grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(10, 2, 16, 16, 512))
    """Hash grid of the appearance."""
    bottleneck_width: int = 32
    """Length of the bottleneck feature b (256 in camp_zipnerf)."""
    hidden_width: int = 64
    """Width of the layers of both radiance fields."""
    num_hidden_layers: int = 1
    """Hidden layers of each radiance field."""
    num_direction_octaves: int = 3
    """Octaves of the encoding of directions."""
    latent_width: int = 8
    """Length of a latent code; 0 leaves AffineGLO out."""
    latent_hidden_width: int = 32
    """Width of AffineGLO's hidden layer."""
    radiance: Literal["blended", "camera", "reflected"] = "blended"
    """UniSDF's two radiance fields and their blend (supplement A.1), or one of the two alone, for comparison."""


class AffineGLO(nn.Module):
    """Latent code to an element-wise scale and shift of the bottleneck (Zip-NeRF; supplement A.1).

    The zero code leaves the bottleneck as it is: the network has no biases.
    """

    def __init__(self, latent_width: int, hidden_width: int, bottleneck_width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(latent_width, hidden_width, bias=False),
            nn.SiLU(),
            nn.Linear(hidden_width, 2 * bottleneck_width, bias=False),
        )

    def forward(
        self, bottleneck: Float[Tensor, "points width"], latents: Float[Tensor, "points latent"]
    ) -> Float[Tensor, "points width"]:
        """exp(log scale) * bottleneck + shift."""
        log_scale, shift = self.mlp(latents).chunk(2, -1)
        return bottleneck * log_scale.clamp(-5, 5).exp() + shift


class AppearanceField(nn.Module):
    """Camera-view and reflected radiance and the raw blend weight, per sample.

    Deviation: the bottleneck comes from a hash grid of its own and not from the geometry's. With the geometry
    frozen the latent NeRF could otherwise not learn the shadows that a new light casts.
    """

    def __init__(self, config: AppearanceConfig) -> None:
        super().__init__()
        self.config = config
        self.precision: Precision = "float32"
        self.grid = HashGrid(config.grid)
        self.bottleneck = nn.Sequential(
            nn.Linear(config.grid.width, config.hidden_width),
            nn.ReLU(),
            nn.Linear(config.hidden_width, config.bottleneck_width),
        )
        is_blended = config.radiance == "blended"
        self.blend = nn.Linear(config.bottleneck_width, 1) if is_blended else None
        width = 3 + encoded_width(config.num_direction_octaves) + 3 + config.bottleneck_width
        self.camera_radiance = None if config.radiance == "reflected" else _radiance_mlp(width, config)
        self.reflected_radiance = None if config.radiance == "camera" else _radiance_mlp(width, config)
        self.glo = None
        if config.latent_width:
            self.glo = AffineGLO(config.latent_width, config.latent_hidden_width, config.bottleneck_width)

    def forward(
        self,
        positions: Float[Tensor, "points 3"],
        directions: Float[Tensor, "points 3"],
        normals: Float[Tensor, "points 3"],
        latents: Float[Tensor, "points latent"] | None = None,
        level_weights: Float[Tensor, " levels"] | None = None,
    ) -> Float[Tensor, "points 7"]:
        """Camera-view sRGB, reflected sRGB, raw blend weight; of one radiance field alone, it twice and 0. `latents`
        None stands for the zero code."""
        features = self.grid(positions, level_weights)
        with autocast(positions.device, self.precision):
            bottleneck = self.bottleneck(features)
            if latents is not None and self.glo is not None:
                bottleneck = self.glo(bottleneck, latents)
            octaves = self.config.num_direction_octaves
            mirrored = encode_directions(reflect(directions, normals), octaves)
            radiance = []
            if self.camera_radiance is not None:
                seen = encode_directions(directions, octaves)
                radiance.append(self.camera_radiance(_joined(positions, seen, normals, bottleneck)))
            if self.reflected_radiance is not None:
                radiance.append(self.reflected_radiance(_joined(positions, mirrored, normals, bottleneck)))
            raw = torch.zeros_like(bottleneck[:, :1]) if self.blend is None else self.blend(bottleneck)
        # what is summed along rays and compared with photographs has the positions' digits
        camera, reflected, raw = (part.to(positions.dtype) for part in (radiance[0], radiance[-1], raw))
        return torch.cat([torch.sigmoid(camera), torch.sigmoid(reflected), raw], -1)


def blend_radiance(rendered: Float[Tensor, "rays 7"]) -> Float[Tensor, "rays 3"]:
    """Blend the volume-rendered fields per ray (UniSDF): W * reflected + (1 - W) * camera view."""
    camera, reflected, raw = rendered.split([3, 3, 1], -1)
    share = torch.sigmoid(raw)
    return share * reflected + (1 - share) * camera


def _joined(positions: Tensor, directions: Tensor, normals: Tensor, bottleneck: Tensor) -> Tensor:
    """The input of a radiance field in the bottleneck's precision: float32 would be copied twice."""
    parts = [part.to(bottleneck.dtype) for part in (positions, directions, normals)]
    return torch.cat([*parts, bottleneck], -1)


def _radiance_mlp(width: int, config: AppearanceConfig) -> nn.Sequential:
    layers: list[nn.Module] = []
    for _ in range(config.num_hidden_layers):
        layers += [nn.Linear(width, config.hidden_width), nn.ReLU()]
        width = config.hidden_width
    return nn.Sequential(*layers, nn.Linear(width, 3))
