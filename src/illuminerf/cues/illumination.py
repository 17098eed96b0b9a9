"""The unknown light of a capture, from the colours of points whose shape is known.

Deviation: not in the paper, which tells the relighting model nothing of the photographs' own light.

A diffuse point shows B = albedo * (T E + F B): T is how much of the radiance E of every direction reaches it, shadows
included, and F how much of what other points show. Of all lights the one is taken under which albedo varies least:
log B - log(T E + F B) shall agree between points that are near each other and between points anywhere whose colours
differ in brightness only. The penalty is robust (Geman and McClure), so that edges of paint cost no more than a
constant, and starts wide (graduated non-convexity). Differences of chromaticity count more than those of brightness:
light changes colour less than paint does. A smooth and even light is preferred. Each channel's gain cannot be known:
the light is made neutral, and so bright that the lightest paint is a light grey.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from illuminerf.cues.surface_samples import SurfacePoints
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.workflow.errors import UserError

_DARKEST = 1e-3  # linear; half of the first step of 8-bit sRGB is 1.5e-4
_NARROWEST_ROW = 0.15
_CHROMA_STIFFNESS = 2.0  # colour of light varies less than its brightness
_LIGHTEST_QUANTILE, _LIGHTEST_ALBEDO = 0.95, 0.65  # the upper quartile of 129 objects with known materials
_DIMMEST_WHITE = 0.2  # linear


@dataclass(frozen=True)
class LightFit:
    """How a light is fitted to the colours of points."""

    map_height: int = 16
    """Rows of the estimated map; it has twice as many columns."""
    near_radii: tuple[float, ...] = (0.03, 0.1, 0.3)
    """Pairs of neighbours are drawn within these distances, in radii of the unit ball."""
    pairs_per_point: int = 6
    """Neighbours of each point within each radius."""
    far_pairs_per_point: int = 18
    """Points anywhere that each point is compared with; all together they weigh as much as all near pairs."""
    chroma_width: float = 0.3
    """Difference of chromaticity, in logarithms, at which colours begin to count as those of different paints."""
    chroma_weight: float = 4.0
    """How much more differences of chromaticity count than those of brightness."""
    edge_width: float = 0.2
    """Difference of log albedo above which a pair counts as two paints."""
    widening: tuple[float, ...] = (4.0, 2.0, 1.0)
    """`edge_width` is multiplied by these in the rounds of the fit."""
    steps_per_round: int = 60
    """L-BFGS iterations of each round."""
    dark_level: float = 0.02
    """Linear level below which colours, more gloss and noise than paint, count little."""
    smoothness: float = 0.03
    """Weight of the squared differences of log radiance between neighbouring texels."""
    evenness: float = 0.01
    """Weight of the variance of log radiance."""
    bounce_rays: int = 64
    """Rays per point that look for light from other points."""

    def __post_init__(self) -> None:
        if not 4 <= self.map_height <= 64:
            raise UserError("map_height is out of range", got=str(self.map_height), wanted="4 to 64")
        counts = (self.pairs_per_point, self.far_pairs_per_point, self.steps_per_round, self.bounce_rays)
        if min(counts) < 1 or not self.near_radii or not self.widening:
            raise UserError("the fit of the light needs pairs and steps", wanted="numbers of 1 or more")
        widths = (self.chroma_width, self.edge_width, *self.near_radii, *self.widening)
        weights = (self.chroma_weight, self.dark_level, self.smoothness, self.evenness)
        if not all(0 < value < np.inf for value in widths) or not all(0 <= value < np.inf for value in weights):
            raise UserError("a width or weight of the fit of the light is out of range", wanted="positive numbers")


@dataclass(frozen=True)
class FittedLight:
    """A light and what it says about the points.

    Attributes:
        light: linear radiance, scaled as the module's docstring says.
        shading: float32 [points, 3], T E + F B of that light.
        albedo: float32 [points, 3], colour / shading.
        residual: mean penalty of the pairs: 0 where all albedos agree, 1 where none do.
        explained: share of the variance of log colour that is gone from log albedo; negative where the fit made it
            worse.
    """

    light: EnvironmentMap
    shading: np.ndarray
    albedo: np.ndarray
    residual: float
    explained: float


def fit_light(
    points: SurfacePoints,
    colors: np.ndarray,
    transport: np.ndarray,
    bounces: csr_matrix,
    config: LightFit,
    generator: np.random.Generator,
) -> FittedLight:
    """Find the light under which the albedo of points varies least.

    Args:
        points: on the surface.
        colors: linear colours of the points, float32 [points, 3].
        transport: T, float32 [points, texels] of `light_transport` with `config.map_height` rows.
        bounces: F, [points, points] of `interreflection`.
        config: the settings.
        generator: draws the pairs.
    """
    log_colors = np.log(np.maximum(colors, _DARKEST)).astype(np.float64)
    pairs = Pairs.drawn(points.positions, log_colors, config, generator)
    indirect = bounces @ colors.astype(np.float64)
    shape = (config.map_height, 2 * config.map_height, 3)
    log_light = np.zeros(shape)
    for widening in config.widening:
        # light from other points depends on the gain of the light, which is that of the last round
        direct = _shading(log_light, transport)
        gain = _gain(direct, colors)
        unbounced = log_colors - np.log1p(indirect / (gain * direct))

        def loss(flat: np.ndarray, width: float = widening * config.edge_width, target: np.ndarray = unbounced) -> Any:
            value, gradient = light_loss(flat.reshape(shape), target, transport, pairs, width, config)
            return value, gradient.ravel()

        options = {"maxiter": config.steps_per_round, "maxcor": 20}
        log_light = minimize(loss, log_light.ravel(), jac=True, method="L-BFGS-B", options=options).x.reshape(shape)
    direct = _shading(log_light, transport)
    gain = _gain(direct, colors)
    shading = gain * direct + indirect
    log_albedo = log_colors - np.log(shading)
    return FittedLight(
        EnvironmentMap((np.exp(log_light) * gain).astype(np.float32), "estimated"),
        shading.astype(np.float32),
        np.exp(log_albedo).astype(np.float32),
        pairs.penalty(log_albedo, config.edge_width)[0],
        float(1 - log_albedo.var(0).sum() / max(log_colors.var(0).sum(), 1e-12)),
    )


def uniform_light(height: int) -> EnvironmentMap:
    """White from everywhere: what is assumed where nothing is known."""
    return EnvironmentMap(np.ones((height, 2 * height, 3), np.float32), "uniform")


def _gain(shading: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Per channel, float [3]: mean log shading grey, and the lightest paints light, unless white would then
    look dark in the photographs: nobody exposes like that, the object is dark."""
    neutral = np.exp(-np.log(shading).mean(0))
    white = shading * neutral
    lightest = np.quantile((colors / white).mean(-1), _LIGHTEST_QUANTILE)
    return neutral * max(lightest / _LIGHTEST_ALBEDO, _DIMMEST_WHITE / white.mean())


@dataclass(frozen=True)
class Pairs:
    """Weighted pairs of points whose paint may be the same."""

    difference: csr_matrix
    """[pairs, points], 1 and -1 in every row."""
    weights: np.ndarray
    """[pairs], sum 1."""
    mixing: np.ndarray
    """[3, 3], weights of brightness and chromaticity."""

    @staticmethod
    def drawn(
        positions: np.ndarray, log_colors: np.ndarray, config: LightFit, generator: np.random.Generator
    ) -> "Pairs":
        num_points = len(positions)
        near = _near_pairs(positions, config, generator)
        first = np.repeat(np.arange(num_points), config.far_pairs_per_point)
        far = np.stack([first, generator.integers(0, num_points, len(first))], -1)
        index = np.concatenate([near, far])
        chroma = log_colors - log_colors.mean(1, keepdims=True)
        distance = np.square(chroma[index[:, 0]] - chroma[index[:, 1]]).sum(1)
        level = np.exp(log_colors).mean(1)
        trust = level / (level + config.dark_level)
        weights = np.exp(-0.5 * distance / config.chroma_width**2) * trust[index].prod(1)
        weights *= np.where(np.arange(len(index)) < len(near), 1 / len(near), 1 / len(far))
        rows = np.repeat(np.arange(len(index)), 2)
        signs = np.tile([1.0, -1.0], len(index))
        difference = csr_matrix((signs, (rows, index.ravel())), shape=(len(index), num_points))
        return Pairs(difference, weights / weights.sum(), _mixing(1.0, config.chroma_weight))

    def penalty(self, log_albedo: np.ndarray, width: float) -> tuple[float, np.ndarray]:
        """Geman-McClure penalty of the differences of log albedo [points, 3], and its gradient."""
        gap = self.difference @ (log_albedo @ self.mixing)
        square = np.square(gap).mean(1) + width**2
        slope = gap * (self.weights * (2 / 3) * width**2 / np.square(square))[:, None]
        return float(self.weights @ (1 - width**2 / square)), (self.difference.T @ slope) @ self.mixing


def _mixing(grey_weight: float, chroma_weight: float) -> np.ndarray:
    """Symmetric float [3, 3] that weights the mean of three channels and what differs from it."""
    grey = np.full((3, 3), 1 / 3)
    return grey_weight * grey + chroma_weight * (np.eye(3) - grey)


def _near_pairs(positions: np.ndarray, config: LightFit, generator: np.random.Generator) -> np.ndarray:
    tree = cKDTree(positions)
    found = [np.zeros((0, 2), int)]
    for radius in config.near_radii:
        for point, near in enumerate(tree.query_ball_point(positions, radius, return_sorted=True)):
            count = min(config.pairs_per_point, len(near))
            chosen = generator.choice(near, count, replace=False)
            found.append(np.stack([np.full(count, point), chosen], -1))
    return np.concatenate(found)


def light_loss(
    log_light: np.ndarray,
    log_colors: np.ndarray,
    transport: np.ndarray,
    pairs: Pairs,
    width: float,
    config: LightFit,
) -> tuple[float, np.ndarray]:
    """What the fit minimises, and its gradient by `log_light` [height, width, 3]."""
    shading = _shading(log_light, transport)
    value, by_albedo = pairs.penalty(log_colors - np.log(shading), width)
    by_radiance = transport.T @ (-by_albedo / shading).astype(np.float32)
    prior, by_prior = _prior(log_light, config)
    return value + prior, by_radiance.reshape(log_light.shape) * np.exp(log_light) + by_prior


def _shading(log_light: np.ndarray, transport: np.ndarray) -> np.ndarray:
    """Float64 [points, 3], a little above 0 also where no light comes."""
    return (transport @ np.exp(log_light).reshape(-1, 3).astype(np.float32)).astype(np.float64) + _DARKEST


def _prior(log_light: np.ndarray, config: LightFit) -> tuple[float, np.ndarray]:
    """Smoothness over angles and evenness of log radiance, stiffer for its chromaticity; and the gradient."""
    height = len(log_light)
    mixing = _mixing(3**-0.5, _CHROMA_STIFFNESS)
    mixed = (log_light - log_light.mean()) @ mixing
    cosine = np.cos((0.5 - (np.arange(height) + 0.5) / height) * np.pi)
    across = 1 / np.maximum(cosine, _NARROWEST_ROW)[:, None, None]
    side = mixed - np.roll(mixed, 1, 1)
    down = np.diff(mixed, axis=0)
    smooth, even = (weight / (2 * height * height) for weight in (config.smoothness, config.evenness))
    value = smooth * ((across * side**2).sum() + (down**2).sum()) + even * (mixed**2).sum()
    slope = 2 * smooth * across * (side - np.roll(side, -1, 1)) + 2 * even * mixed
    slope[1:] += 2 * smooth * down
    slope[:-1] -= 2 * smooth * down
    gradient = slope @ mixing
    return float(value), gradient - gradient.mean()
