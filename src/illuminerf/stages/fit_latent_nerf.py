"""RelitViews + Geometry -> LatentNerf: one 3D appearance that explains all relit samples through latent codes.

On several GPUs (or, through gloo, several CPU processes), which share the rays of every step and the folder:

    torchrun --nproc-per-node 8 -m illuminerf fit-latent-nerf GEOMETRY CAPTURE RELIT --out LATENT_NERF
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from illuminerf.data.capture import load_capture
from illuminerf.fields.optimisation import OptimiserConfig, fit
from illuminerf.fields.radiance_field import RadianceField
from illuminerf.fields.ray_pool import RayPool, gather_rays
from illuminerf.fields.recorded_steps import RecordableLoss
from illuminerf.fields.shading_cache import ShadingCache, cache_shading, latent_loss
from illuminerf.fields.shading_slots import ShadingSlots
from illuminerf.fields.storage import StoredField, load_field, save_field
from illuminerf.scene.images import read_png_bytes
from illuminerf.workflow.device import derived_seed, torch_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.processes import Team, join, open_together
from illuminerf.workflow.progress import track

_RECENT_SHARE = 0.98  # of the running PSNR that stays from step to step
_LEAST_COVERAGE = 0.5  # below it a pixel says little of the object's colour


@dataclass(frozen=True)
class Config:
    """The latent NeRF (section 3.3, supplement A.1); the defaults are the embedded preset."""

    optimiser: OptimiserConfig = field(
        default_factory=lambda: OptimiserConfig(num_steps=3000, rays_per_step=1024, warmup_steps=60)
    )
    """Steps, rays, learning rates."""
    num_kept: int = 4
    """Heaviest samples of each ray that are shaded."""
    max_rays: int = 400_000
    """Pixels that are trained on, drawn at random over all views; each is cached once and seen in every sample."""
    use_latents: bool = True
    """One latent code per relit image; False is the paper's ablation, a standard NeRF."""
    shuffles_latents: bool = False
    """At every step each image gets the code of another one, drawn at random, so that codes can explain nothing: a
    check that they do explain something otherwise."""
    latent_penalty: float = 1e-4
    """Weight of the mean squared norm of the latent codes."""
    zero_code_share: float = 0.5
    """Share of each step's rays that see the zero code instead of their image's, so that the zero code, which is
    rendered at test, stands for the mean of all samples."""
    seed: int = 0
    """Seed of latents, network and batches."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if min(self.num_kept, self.max_rays) < 1 or self.latent_penalty < 0:
            raise UserError("num_kept and max_rays must be positive, the penalty not negative", got=str(self))
        if not 0 <= self.zero_code_share < 1:
            raise UserError("zero_code_share is a share of the rays", got=f"{self.zero_code_share}", wanted="below 1")
        if self.shuffles_latents and not self.use_latents:
            raise UserError("there are no codes to shuffle", got="use_latents false", fix="leave shuffles_latents out")

    @classmethod
    def paper(cls) -> "Config":
        """The paper's settings."""
        return cls(optimiser=OptimiserConfig.paper(), num_kept=16, max_rays=4_000_000, zero_code_share=0.0)


class _LatentNerf(nn.Module):
    """What is optimised: the appearance of a field whose geometry is frozen, and the latent codes."""

    def __init__(self, radiance_field: RadianceField, num_images: int, generator: torch.Generator) -> None:
        super().__init__()
        self.appearance = radiance_field.appearance
        width = radiance_field.config.appearance.latent_width
        codes = 0.01 * torch.randn(num_images, width, generator=generator)
        self.latents = nn.Parameter(codes.to(next(self.appearance.parameters()).device))


def run(geometry_path: Path, capture_path: Path, relit_path: Path, config: Config, out: Path) -> Path:
    """Distil relit samples into a latent NeRF.

    Raises:
        UserError: samples are missing or do not fit the capture, or the geometry has no latent conditioning.
    """
    inputs: dict[str, Path | str] = {
        "geometry": geometry_path,
        "capture": capture_path,
        "relit": relit_path,
    }
    team, device = join(config.device)
    with open_together(team, out, "fit_latent_nerf", config, inputs) as artefact:
        if artefact.is_done:
            return out
        stored = load_field(geometry_path, device)
        if config.use_latents and stored.field.config.appearance.latent_width < 1:
            raise UserError(
                "this geometry's field has no room for latent codes",
                got="latent_width 0",
                fix="fit the geometry with latent_width of at least 1, or set use_latents to false",
            )
        views = load_capture(capture_path).views
        sample_views, num_samples = find_samples(relit_path, len(views))
        is_opaque = any((alpha > _LEAST_COVERAGE).any() for alpha in views.alphas(sample_views))
        least = _LEAST_COVERAGE if is_opaque else 0.0
        pool = gather_rays(views.cameras[sample_views], views.alphas(sample_views), stored.cells, device, least)
        pool = pool.foreground_subset(config.max_rays, torch_generator(config.seed, "pixels", device=device))
        targets = _targets(relit_path, pool, sample_views, num_samples)
        cache = cache_shading(stored.field, pool, config.num_kept)
        coverage = pool.values(views.alphas(sample_views))
        generator = torch_generator(config.seed, "latents")
        model = _LatentNerf(stored.field, len(sample_views) * num_samples, generator)
        psnr = _fit(model, stored.field, cache, pool, targets, coverage, config, out / "checkpoint.safetensors", team)
        if not team.is_first:
            return out
        latents = model.latents.detach() if config.use_latents else None
        save_field(out, StoredField(stored.field, stored.cells, latents))
        (out / "checkpoint.safetensors").unlink(missing_ok=True)
        artefact.finish({"num_views": len(sample_views), "num_samples": num_samples, "train_psnr": psnr})
    return out


def find_samples(relit_path: Path, num_views: int) -> tuple[list[int], int]:
    """Views that have relit samples, and how many each has.

    Raises:
        UserError: there are none, some views have fewer than others, or a view is not one of the capture.
    """
    found: dict[int, set[int]] = {}
    for path in sorted((relit_path / "samples").glob("*.png")):
        if match := re.fullmatch(r"(\d+)_(\d+)\.png", path.name):
            found.setdefault(int(match[1]), set()).add(int(match[2]))
    if not found:
        raise UserError(f"{relit_path} holds no relit samples", wanted="samples/<view>_<sample>.png")
    views, num_samples = sorted(found), max(len(samples) for samples in found.values())
    for view in views:
        if found[view] != set(range(num_samples)):
            raise UserError(
                f"view {view} of {relit_path} lacks relit samples",
                got=f"{len(found[view])}",
                wanted=f"{num_samples}, numbered from 0",
                fix="run relight_views again; it goes on where it stopped",
            )
    if views[-1] >= num_views:
        raise UserError(
            f"{relit_path} was not made from this capture",
            got=f"a sample of view {views[-1]}",
            wanted=f"views 0 to {num_views - 1}",
        )
    return views, num_samples


def _fit(
    model: _LatentNerf,
    radiance_field: RadianceField,
    cache: ShadingCache,
    pool: RayPool,
    targets: Tensor,
    coverage: Float[Tensor, " rays"],
    config: Config,
    checkpoint: Path,
    team: Team,
) -> float:
    """Optimise; returns the PSNR over the last steps.

    At an outline, mask and surface never quite agree. There the surface shall have the object's colour, not a dark one
    that makes up for too much opacity: targets over black are brought from the mask's coverage to the surface's.

    Deviation: rays pass through random places of their pixels. Through the middles alone, hash cells finer than a pixel
    each learn the noise of a handful of samples, and unseen views are grainy.

    Deviation: some rays see the zero code. Left to the penalty alone, it renders something else than the samples' mean,
    and unseen views are further from the truth.
    """
    device = cache.weights.device
    num_samples, rays = len(targets), config.optimiser.rays_per_step
    own, slots, generator = team.own(rays), ShadingSlots(), torch.Generator(device)
    to_opacity = (cache.weights.sum(-1) / coverage.clamp_min(1e-3))[:, None]
    is_coded = torch.arange(rays, device=device)[own, None] >= int(config.zero_code_share * rays)
    recent = torch.full((), torch.nan, dtype=torch.float64, device=device)

    def prepare(step: int) -> None:
        generator.manual_seed(derived_seed(config.seed, "latent nerf", step))

    def loss() -> tuple[Tensor, dict[str, Tensor]]:
        index = torch.randint(pool.num_foreground, (rays,), generator=generator, device=device)[own]
        sample = torch.randint(num_samples, (rays,), generator=generator, device=device)[own]
        target = (targets[sample, index].float() / 255 * to_opacity[index]).clamp_max(1)
        latents = None
        if config.use_latents:
            image = pool.view[index] * num_samples + sample
            if config.shuffles_latents:
                others = torch.randint(max(len(model.latents) - 1, 1), (rays,), generator=generator, device=device)
                image = (image + 1 + others[own]) % len(model.latents)
            latents = model.latents.index_select(0, image)
        within = torch.rand(rays, 2, generator=generator, device=device)[own] - 0.5
        penalty = config.latent_penalty
        total, numbers = latent_loss(
            radiance_field, cache, index, target, latents, penalty, within, team, rays, slots, is_coded
        )
        found = numbers["psnr"].to(device)
        recent.copy_(torch.where(recent.isnan(), found, _RECENT_SHARE * recent + (1 - _RECENT_SHARE) * found))
        return total, {"psnr": recent}

    steps = RecordableLoss(prepare, loss, generator, rays * cache.weights.shape[1], slots)
    with radiance_field.computing_in(config.optimiser.precision):
        fit(model, config.optimiser, steps, checkpoint, "fit latent NeRF", team=team)
    return float(recent)


def _targets(relit_path: Path, pool: RayPool, views: list[int], num_samples: int) -> Tensor:
    """The samples' colours at the pool's foreground rays: uint8 [samples, rays, 3], premultiplied sRGB."""
    height, width = pool.cameras.height, pool.cameras.width
    targets = torch.empty(num_samples, pool.num_foreground, 3, dtype=torch.uint8)
    of_ray, pixel = pool.view[: pool.num_foreground].cpu(), pool.pixel[: pool.num_foreground].cpu()
    for number, view in enumerate(track(views, "read samples")):
        rays = (of_ray == number).nonzero()[:, 0]
        for sample in range(num_samples):
            path = relit_path / "samples" / f"{view:03d}_{sample:02d}.png"
            image = read_png_bytes(path)
            if image.shape[:2] != (height, width):
                raise UserError(
                    f"{path} has another size than the capture",
                    got=f"{image.shape[1]} x {image.shape[0]}",
                    wanted=f"{width} x {height}",
                )
            targets[sample, rays] = torch.from_numpy(image.reshape(height * width, -1)[pixel[rays].numpy(), :3])
    return targets.to(pool.view.device)
