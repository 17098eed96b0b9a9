"""RelightingPairs -> RelightingModel (paper, supplement, "Relighting Diffusion Model").

Batches derive from (seed, step, process) alone, so an interrupted run goes on exactly where it stopped. It grows in
phases: resolution and terms of the loss change at fixed steps (small models on few cores learn most at 64 pixels).
The folder of items may still be growing: it is listed again at every checkpoint.
"""

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from accelerate import Accelerator, DistributedDataParallelKwargs

from illuminerf.diffusion.augmentation import AugmentationConfig, make_batch
from illuminerf.diffusion.objective import LossWeights, TrainingObjective
from illuminerf.diffusion.relighting_model import (
    RelightingModel,
    RelightingModelConfig,
    load_model,
    save_model,
)
from illuminerf.diffusion.relighting_scores import evaluate
from illuminerf.diffusion.training_items import TrainingItem, load_items
from illuminerf.diffusion.training_state import (
    WeightAverage,
    learning_rate,
    restore_training,
    save_training,
)
from illuminerf.scene.images import write_png
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.device import torch_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, step_progress

STAGE = "train_relighting_model"
_CHECKPOINT = "training.safetensors"
_GRID_ROWS = ("input", "diffuse_cue", "truth", "anchor", "sample", "mean", "bound")


@dataclass(frozen=True)
class Phase:
    """A stretch of training."""

    num_steps: int
    """Optimisation steps."""
    size: int
    """Pixels per side."""
    trains: Literal["products", "diffusion", "all"] = "all"
    """Only ConvNet 2, by the composited products; everything but ConvNet 2; or all."""

    def __post_init__(self) -> None:
        if self.num_steps < 1 or self.size < 8:
            raise UserError("a phase has at least one step and 8 pixels")


@dataclass(frozen=True)
class Config:
    """How the relighting model is trained."""

    model: RelightingModelConfig = field(default=RelightingModelConfig())
    """Sizes of the networks."""
    phases: tuple[Phase, ...] = (Phase(1500, 64, "products"), Phase(2000, 64), Phase(1000, 128))
    """In order. Deviation: the paper trains 150,000 steps at one resolution."""
    batch_size: int = 32
    """Examples per step and process (paper: 512 in all)."""
    accumulation: int = 1
    """Batches whose gradients are added up per step."""
    peak_learning_rate: float = 1e-3
    """After warm-up. Deviation: paper 1e-4, for a model a hundred times larger."""
    warm_up_steps: int = 100
    """Linear from 0 (paper: 1000)."""
    final_share: float = 0.3
    """Share of all steps over which the rate falls to 0. Deviation: the paper's stays constant."""
    average_decay: float = 0.999
    """Of the exponential moving average of the weights, which are what is exported."""
    loss: LossWeights = field(default=LossWeights())
    """Terms of the loss."""
    augmentation: AugmentationConfig = field(default=AugmentationConfig())
    """Variations of the examples."""
    initial_model: str = ""
    """Folder of a model to start from, or "" for fresh weights."""
    checkpoint_seconds: float = 180.0
    """Time between checkpoints."""
    validation_seconds: float = 600.0
    """Time between validations."""
    device: str = "auto"
    """Where it runs: auto, cpu or cuda."""
    seed: int = 0
    """Seed of weights, batches and noise."""

    def __post_init__(self) -> None:
        if not self.phases or self.batch_size < 1 or self.accumulation < 1:
            raise UserError("training needs a phase, a batch and an accumulation of at least one")
        if not 0 <= self.average_decay < 1 or self.peak_learning_rate <= 0:
            raise UserError("average_decay must lie in [0, 1) and the learning rate be positive")

    @property
    def num_steps(self) -> int:
        """Optimisation steps over all phases."""
        return sum(phase.num_steps for phase in self.phases)

    def phase_at(self, step: int) -> Phase:
        """The phase that optimisation step `step` belongs to."""
        for phase in self.phases:
            if step < phase.num_steps:
                return phase
            step -= phase.num_steps
        return self.phases[-1]

    def scale_momentum_at(self, step: int) -> float:
        """How fast the latent scales follow: a running mean at first, then slowly, and not in the last third."""
        start = 0
        for phase in self.phases:
            if phase.trains != "products":
                break
            start += phase.num_steps
        return max(0.02, 1 / (1 + step - start)) if step < self.num_steps * 2 / 3 else 0.0


def run(pairs: Path, held_out: Path, config: Config, out: Path) -> Path:
    """Train on the items of `pairs`, validate on those of `held_out`; `out` becomes a model folder.

    Raises:
        UserError: a folder holds no items, or the device is absent.
    """
    inputs: dict[str, Path | str] = {"pairs": str(pairs), "held_out": str(held_out)}
    with open_artefact(out, STAGE, config, inputs) as artefact:
        if artefact.is_done:
            return out
        training = _Training(pairs, held_out, config, out)
        training.fit()
        averaged = training.averaged_model()
        save_model(averaged, out)
        scores = training.validate(config.num_steps, num_pairs=48)
        artefact.finish({"scores": scores, "seconds": training.seconds})
    return out


class _Training:
    """One process's run."""

    def __init__(self, pairs: Path, held_out: Path, config: Config, out: Path) -> None:
        self.config, self.pairs, self.held_out, self.out = config, pairs, held_out, out
        unused = DistributedDataParallelKwargs(find_unused_parameters=True)
        self.accelerator = Accelerator(cpu=config.device == "cpu", kwargs_handlers=[unused])
        torch.manual_seed(config.seed)
        model = load_model(Path(config.initial_model)) if config.initial_model else RelightingModel(config.model)
        self.model = model.train().to(self.accelerator.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = WeightAverage(self.model, config.average_decay)
        self.optimizer = torch.optim.AdamW(
            self.model.parameters(), lr=config.peak_learning_rate, weight_decay=0.01, fused=True
        )
        self.checkpoint = out / _CHECKPOINT
        self.step = 0
        if self.checkpoint.exists():
            self.step = restore_training(self.checkpoint, self.model, self.average, self.optimizer)
        self.objective, self.prepared = self.accelerator.prepare(
            TrainingObjective(self.model, config.loss), self.optimizer
        )
        self.items: dict[int, list[TrainingItem]] = {}
        self.seconds = 0.0

    def fit(self) -> None:
        """All steps that are left, with checkpoints and validations by the clock."""
        started = checked = validated = time.monotonic()
        with step_progress("train relighting model", self.config.num_steps, self.step) as progress:
            while self.step < self.config.num_steps:
                parts = self._one_step()
                progress.advance(1, **parts)
                now = time.monotonic()
                self.seconds = now - started
                if self.accelerator.is_main_process and now - checked > self.config.checkpoint_seconds:
                    self.save()
                    self.items.clear()
                    checked = now
                if self.accelerator.is_main_process and now - validated > self.config.validation_seconds:
                    self.validate(self.step)
                    validated = time.monotonic()
        if self.accelerator.is_main_process:
            self.save()

    def save(self) -> None:
        """Checkpoint the run."""
        save_training(self.checkpoint, self.model, self.average, self.optimizer, self.step)

    def _one_step(self) -> dict[str, float]:
        config, step = self.config, self.step
        phase = config.phase_at(step)
        rate = learning_rate(
            step, config.peak_learning_rate, config.warm_up_steps, config.num_steps, config.final_share
        )
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        momentum = 0.0 if phase.trains == "products" else config.scale_momentum_at(step)
        self.model.conditioning.texture.requires_grad_(phase.trains != "diffusion")
        totals: dict[str, float] = {}
        items = self._items_at(phase.size)
        for part in range(config.accumulation):
            generator = torch_generator(config.seed, "batch", step, part, self.accelerator.process_index)
            batch = make_batch(items, config.batch_size, config.augmentation, generator)
            batch = type(batch)(*(tensor.to(self.accelerator.device) for tensor in batch))
            loss, parts = self.objective(batch, generator, phase.trains != "products", momentum)
            self.accelerator.backward(loss / config.accumulation)
            totals = {name: totals.get(name, 0.0) + value / config.accumulation for name, value in parts.items()}
        self.accelerator.clip_grad_norm_(self.model.parameters(), 1.0)
        self.prepared.step()
        self.prepared.zero_grad()
        self.average.update(self.model, step)
        self.step += 1
        return totals

    def _items_at(self, size: int) -> list[TrainingItem]:
        if size not in self.items:
            self.items = {size: load_items(self.pairs, size)}
            say(f"{len(self.items[size])} training items at {size} pixels")
        return self.items[size]

    def averaged_model(self) -> RelightingModel:
        """The model with averaged weights, for export and validation."""
        averaged = RelightingModel(self.model.config).to(self.accelerator.device)
        averaged.load_state_dict(self.average.tensors)
        return averaged.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]

    def validate(self, step: int, num_pairs: int = 16) -> dict[str, Any]:
        """Scores and a picture grid of the averaged weights on held-out items."""
        phase = self.config.phase_at(max(0, step - 1))
        items = load_items(self.held_out, phase.size)
        scores, images = evaluate(self.averaged_model(), items, num_pairs)
        rows = [torch.cat(list(images[name][:12].clamp(0, 1)), -1) for name in _GRID_ROWS]
        write_png(self.out / "validation" / f"{step:06d}.png", torch.cat(rows, 1).permute(1, 2, 0).cpu().numpy())
        write_json(self.out / "validation" / f"{step:06d}.json", {"step": step, "size": phase.size, "scores": scores})
        say(f"step {step}: " + json.dumps({name: round(s.get("psnr", 0), 2) for name, s in scores.items()}))
        return scores
