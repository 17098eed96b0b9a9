"""Capture + radiance cues + relighting model -> S relit samples of every view (paper, section 3.3).

Where an Illumination artefact is given, the embedded model also sees what the photographs' own light does to a white
object, and specular cues are dimmed to the gloss that the photographs show (Deviation: the paper's model has to guess
both from each photograph alone).

samples/<000>_<00>.png   sRGB over black (premultiplied by the capture's alpha), at the capture's size
seeds.json               the seed of every sample

Several processes or machines can share the work on one folder: `--shard 0/4`, `--shard 1/4`, ..., or one torchrun.
Whoever finds every sample in place seals the artefact.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from illuminerf.cues.renderer import CUE_CHANNELS
from illuminerf.data.capture import load_capture
from illuminerf.diffusion.augmentation import TRAINING_LEVEL
from illuminerf.diffusion.full_size import Photograph, relight_photographs, straight_cues
from illuminerf.diffusion.pretrained import model_folder, pretrained_model
from illuminerf.diffusion.relighter import Relighter
from illuminerf.diffusion.sampling import Sampler
from illuminerf.scene.images import read_exr, write_png
from illuminerf.scene.views import Views
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.device import Precision, autocast, derived_seed, resolve_device
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.processes import shard_of
from illuminerf.workflow.progress import say, step_progress

STAGE = "relight_views"
_METERED_VIEWS = 8
_DARK = 1e-4


@dataclass(frozen=True)
class Config:
    """How many samples are drawn, and how."""

    num_samples: int = 4
    """Samples per view (paper: 16)."""
    num_steps: int = 4
    """Denoising steps; more is slower and no better with the embedded model (docs/model_card.md)."""
    sampler: Sampler = "ddim"
    """Deviation: the paper samples with ddpm; few steps need ddim or dpm_solver."""
    temperature: float = 0.6
    """Factor on the initial noise. Deviation: 1 in the paper; below 1 samples differ less and fit better."""
    batch_size: int = 4
    """Views relit at once."""
    samples_at_once: int = 0
    """Samples of each of these views at once, to save memory; 0: all."""
    precision: Precision = "float32"
    """bfloat16 is faster on GPUs and recent CPUs."""
    shard: str = ""
    """Share of the work that this process does, i/n from 0/n; "": all, or what torchrun says. Changes no result."""
    device: str = "auto"
    """Where it runs: auto, cpu or cuda."""
    seed: int = 0
    """A sample's noise derives from it, the view and the sample's number."""

    def __post_init__(self) -> None:
        if min(self.num_samples, self.num_steps, self.batch_size) < 1 or self.samples_at_once < 0:
            raise UserError("num_samples, num_steps and batch_size must be at least 1, samples_at_once not negative")
        shard_of(self.shard)
        if not 0 <= self.temperature <= 2:
            raise UserError("temperature must lie in [0, 2]", got=str(self.temperature))
        if self.num_samples > 100 or self.num_steps > 1000:
            raise UserError("at most 100 samples and 1000 steps")


def run(capture: Path, cues: Path, model: Path | str, illumination: Path | None, config: Config, out: Path) -> Path:
    """Relight every view of `capture` into `out`; samples that exist are kept.

    Args:
        capture: a Capture artefact.
        cues: a RadianceCues artefact of the same views.
        model: a RelightingModel folder, "embedded" for the one inside the package, or "dilightnet" once downloaded.
        illumination: an Illumination artefact of the same views, or None.
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: an input is missing or does not fit the others.
    """
    folder = model_folder(model)
    shard, num_shards = shard_of(config.shard)
    inputs: dict[str, Path | str] = {"capture": capture, "cues": cues, "model": folder}
    if illumination is not None:
        inputs["illumination"] = illumination
    keyed = replace(config, shard="")
    with open_artefact(out, STAGE, keyed, inputs, is_shared=num_shards > 1) as artefact:
        if artefact.is_done:
            return out
        views = load_capture(capture).views
        seeds = {
            view: [derived_seed(config.seed, "relight", view, k) for k in range(config.num_samples)]
            for view in range(len(views))
        }
        write_json(out / "seeds.json", {f"{view:03d}": row for view, row in seeds.items()})
        # A batch is redone whole: convolutions round differently in batches of another size.
        batches = [list(seeds)[start : start + config.batch_size] for start in range(0, len(seeds), config.batch_size)]
        ours = batches[shard::num_shards]
        todo = [batch for batch in ours if not _is_relit(out, batch, config.num_samples)]
        if todo:
            sources = _Sources(views, cues, illumination, gloss_of(illumination))
            _relight_all(folder, sources, ours, todo, seeds, config, out)
        if _is_relit(out, list(seeds), config.num_samples):
            artefact.finish({"num_views": len(views), "num_samples": config.num_samples})
        else:
            say(f"share {shard}/{num_shards} is done; others are not yet")
    return out


def sample_path(folder: Path, view: int, sample: int) -> Path:
    """samples/<000>_<00>.png of the relit views in `folder`."""
    return folder / "samples" / f"{view:03d}_{sample:02d}.png"


def _is_relit(out: Path, batch: list[int], num_samples: int) -> bool:
    return all(sample_path(out, view, k).exists() for view in batch for k in range(num_samples))


class _Sources(NamedTuple):
    """Where a view's pixels come from."""

    views: Views
    cues: Path
    illumination: Path | None
    gloss: float


def _relight_all(
    folder: Path,
    sources: _Sources,
    ours: list[list[int]],
    todo: list[list[int]],
    seeds: dict[int, list[int]],
    config: Config,
    out: Path,
) -> None:
    device = resolve_device(config.device)
    if device == torch.device("cuda"):  # under a launcher each process has a GPU of its own
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    network = pretrained_model(folder, device)
    exposure = exposure_for(len(sources.views), sources.cues)
    num_views = sum(map(len, ours))
    with step_progress("relight views", num_views, num_views - sum(map(len, todo))) as progress:
        for batch in todo:
            with autocast(device, config.precision):
                _relight(network, sources, batch, [seeds[view] for view in batch], config, out, exposure)
            progress.advance(len(batch))


def _relight(
    network: Relighter,
    sources: _Sources,
    batch: list[int],
    seeds: list[list[int]],
    config: Config,
    out: Path,
    exposure: float,
) -> None:
    photographs = []
    for view in batch:
        name = f"{view:03d}.exr"
        shading = None if sources.illumination is None else sources.illumination / "shading" / name
        cues = sources.cues / "cues" / name
        photographs.append(photograph(sources.views, view, cues, shading, sources.gloss, network.device))
    relit = relight_photographs(
        network,
        photographs,
        seeds,
        config.num_steps,
        config.sampler,
        config.temperature,
        config.samples_at_once,
        exposure,
    )
    images = {
        sample_path(out, view, sample): image.permute(1, 2, 0).cpu().numpy()
        for view, samples in zip(batch, relit, strict=True)
        for sample, image in enumerate(samples)
    }
    with ThreadPoolExecutor() as threads:  # on a GPU it takes longer to compress a picture than to make it
        list(threads.map(write_png, images.keys(), images.values()))


def exposure_for(num_views: int, cues: Path) -> float:
    """The factor that brings the diffuse cue to the level that models are trained at: one for all views, so that they
    agree, from the mean over covered pixels of a few of them. 1 where the light hardly reaches the object."""
    chosen = np.linspace(0, num_views - 1, min(num_views, _METERED_VIEWS)).round().astype(int)
    total, covered = 0.0, 0.0
    for view in chosen:
        channels = read_exr(Path(cues) / "cues" / f"{view:03d}.exr")
        total += float(sum(channels[name].sum(dtype=np.float64) for name in CUE_CHANNELS[:3]))
        covered += 3 * float(channels["A"].sum(dtype=np.float64))
    level = total / max(covered, 1e-6)
    return TRAINING_LEVEL / level if level > _DARK else 1.0


def gloss_of(illumination: Path | None) -> float:
    """The factor on specular cues that an Illumination artefact asks for; 1 where nothing is known."""
    gloss = None if illumination is None else read_json(illumination / "light.json").get("gloss")
    return 1.0 if gloss is None else float(gloss)


def photograph(
    views: Views, view: int, cues: Path, shading: Path | None, gloss: float, device: torch.device
) -> Photograph:
    """A view of a capture as the model takes it.

    Args:
        views: the capture's.
        view: which of them.
        cues: EXR of its radiance cues under the target light.
        shading: EXR of its diffuse shading under the photographs' own light; None: unknown.
        gloss: see `gloss_of`.
        device: where it goes.

    Raises:
        UserError: a file lacks a channel or has another size.
    """
    alpha = views.alpha[view]
    target = _straight(cues, CUE_CHANNELS, alpha.shape)
    target[3:] *= gloss
    own = np.zeros((3, *alpha.shape), np.float32) if shading is None else _straight(shading, "RGB", alpha.shape)
    masked = np.concatenate([views.srgb[view] * alpha[..., None], alpha[..., None]], -1)
    return Photograph(
        torch.from_numpy(np.ascontiguousarray(masked.transpose(2, 0, 1))).float().to(device),
        torch.from_numpy(target).float().to(device),
        torch.from_numpy(own).float().to(device),
    )


def _straight(path: Path, names: Sequence[str], shape: tuple[int, ...]) -> Float[np.ndarray, "channels height width"]:
    """Premultiplied channels of an EXR file that also has the mesh's coverage, `A`, as straight ones."""
    channels = read_exr(path)
    missing = [name for name in (*names, "A") if name not in channels]
    if missing:
        raise UserError(f"{path} lacks the channel '{missing[0]}'", fix="delete its folder and make it again")
    if channels["A"].shape != shape:
        raise UserError(
            f"{path} does not fit the capture",
            got=str(channels["A"].shape),
            wanted=str(shape),
            fix="make it from this capture",
        )
    return straight_cues(np.stack([channels[name] for name in names]), channels["A"])
