"""RelightingPairs -> RelightingModel (paper, supplement, "Relighting Diffusion Model").

Two kinds: the embedded model, all of it, from scratch; or, where `control.base` names a base, the paper's: a control on
a frozen base. On a CPU, a GPU, or many under torchrun (docs/training.md).

Examples derive from (seed, step, number in the step) alone, so an interrupted run goes on exactly where it stopped, and
any number of processes see together what one alone would see. Training goes through phases: resolution and terms of the
loss change at fixed steps (small models on few cores learn most at 64 pixels).
"""

import json
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator, DistributedDataParallelKwargs

from illuminerf.diffusion.controlled_base import ControlledBase
from illuminerf.diffusion.example_stream import ExampleStream, Share
from illuminerf.diffusion.frozen_base import load_base
from illuminerf.diffusion.hub import find_base
from illuminerf.diffusion.objective import TrainingObjective, step_totals
from illuminerf.diffusion.pretrained import pretrained_model, save_relighter
from illuminerf.diffusion.relighting_model import RelightingModel
from illuminerf.diffusion.relighting_scores import evaluate
from illuminerf.diffusion.training_config import Config, ExecutionConfig, MonitoringConfig, Phase
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
from illuminerf.workflow.device import autocast, resolve_device
from illuminerf.workflow.metrics_log import MetricsLog
from illuminerf.workflow.processes import closed_at_exit, sum_over_processes
from illuminerf.workflow.progress import StepProgress, say, step_progress

__all__ = ["Config", "ExecutionConfig", "MonitoringConfig", "Phase", "run"]
STAGE = "train_relighting_model"
_CHECKPOINT = "training.safetensors"
_GRID_ROWS = ("input", "diffuse_cue", "truth", "anchor", "sample", "mean", "bound")


@closed_at_exit()
def run(pairs: str | Path, held_out: str | Path, config: Config, out: Path) -> Path:
    """Train on the items of `pairs`, validate on those of `held_out`; `out` becomes a model folder.

    Under torchrun every process calls this; the first one writes.

    Raises:
        UserError: a folder holds no items, the device or the base is absent, or a step cannot be split evenly.
    """
    resolve_device(config.device)
    unused = DistributedDataParallelKwargs(find_unused_parameters=not config.control.base)
    accelerator = Accelerator(cpu=config.device == "cpu", kwargs_handlers=[unused])
    inputs: dict[str, Path | str] = {"pairs": str(pairs), "held_out": str(held_out)}
    if not accelerator.is_main_process:
        if not _agreed(False, accelerator):
            _Training(pairs, held_out, config, out, accelerator).fit()
        accelerator.wait_for_everyone()
        return out
    with open_artefact(out, STAGE, config.key, inputs) as artefact:
        if not _agreed(artefact.is_done, accelerator):
            training = _Training(pairs, held_out, config, out, accelerator)
            training.fit()
            scores = training.finish()
            numbers = {"scores": scores, "seconds": training.seconds, "examples_per_second": training.throughput}
            artefact.finish(numbers)
        accelerator.wait_for_everyone()
    return out


def _agreed(is_done: bool, accelerator: Accelerator) -> bool:
    """What the first process found, for all."""
    return bool(sum_over_processes(torch.tensor(float(is_done), device=accelerator.device)) > 0)


def _build(config: Config) -> RelightingModel | ControlledBase:
    torch.manual_seed(config.seed)
    if config.initial_model:
        return pretrained_model(config.initial_model)
    if not config.control.base:
        return RelightingModel(config.model)
    return ControlledBase(config.control, load_base(find_base(config.control.base, config.control.revision)))


class _Training:
    """One process's run."""

    def __init__(
        self, pairs: str | Path, held_out: str | Path, config: Config, out: Path, accelerator: Accelerator
    ) -> None:
        self.config, self.pairs, self.held_out, self.out = config, pairs, held_out, out
        self.accelerator = accelerator
        self.items: dict[int, list[TrainingItem]] = {}
        self.seconds = self.throughput = 0.0
        share = Share(accelerator.process_index, accelerator.num_processes, config.accumulation)
        share.examples(config.batch_size)
        self.items_at(0)  # missing items are found before the base is loaded
        model = _build(config)
        self.model = model.train().to(accelerator.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        if config.execution.checkpoints_gradients and isinstance(model, ControlledBase):
            model.control.enable_gradient_checkpointing()
        self.average = WeightAverage(self.model, config.average_decay)
        trained = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        self.optimizer = torch.optim.AdamW(trained, lr=config.peak_learning_rate, weight_decay=0.01, fused=True)
        self.checkpoint = out / _CHECKPOINT
        self.step = 0
        if self.checkpoint.exists():
            self.step = restore_training(self.checkpoint, self.model, self.average, self.optimizer)
        self.objective, self.prepared = accelerator.prepare(TrainingObjective(self.model, config.loss), self.optimizer)
        self.stream = ExampleStream(
            config.seed, config.batch_size, share, config.augmentation, model.cue_coding, config.execution.num_threads
        )
        monitoring = config.monitoring
        is_main = accelerator.is_main_process
        self.log = MetricsLog(out, self.step, monitoring.tensorboard) if is_main else None

    def fit(self) -> None:
        """All steps that are left, with checkpoints by the clock and validations by the step."""
        started = checked = logged = time.monotonic()
        every = self.config.monitoring
        shown: dict[str, float] = {}
        with self._progress() as progress:
            while self.step < self.config.num_steps:
                parts = self._one_step()
                if self.step % every.log_steps == 0 or self.step == self.config.num_steps:
                    numbers = self._over_processes(parts)
                    now = time.monotonic()
                    steps = (self.step - 1) % every.log_steps + 1
                    self.throughput = steps * self.config.batch_size / max(now - logged, 1e-9)
                    logged = now
                    shown = {"loss": numbers["loss"], "examples_per_second": self.throughput}
                    if self.log is not None:
                        self.log.write("train", self.step, numbers, examples_per_second=self.throughput)
                if progress is not None:
                    progress.advance(1, **shown)
                now = time.monotonic()
                self.seconds = now - started
                if self.log is not None and self.step % every.validation_steps == 0:
                    self.validate(every.validation_pairs)
                    logged = time.monotonic()
                # after the validation: a run that goes on from here would never make up for one
                if self.log is not None and now - checked > self.config.checkpoint_seconds:
                    self.save()
                    checked = now
        self.stream.close()

    def finish(self) -> dict[str, Any]:
        """Checkpoint, export the averaged weights and score them."""
        self.save()
        with self.average.inside(self.model):
            save_relighter(self.model, self.out)
        scores = self.validate(self.config.monitoring.final_pairs)
        assert self.log is not None
        self.log.close()
        return scores

    def save(self) -> None:
        """Checkpoint the run."""
        save_training(self.checkpoint, self.model, self.average, self.optimizer, self.step)

    def _progress(self) -> AbstractContextManager[StepProgress | None]:
        if not self.accelerator.is_main_process:
            return nullcontext()
        return step_progress("train relighting model", self.config.num_steps, self.step)

    def _over_processes(self, parts: dict[str, torch.Tensor]) -> dict[str, float]:
        """Each process knows what its own examples add; together they are the step's losses."""
        summed = sum_over_processes(torch.stack(list(parts.values())))
        numbers = dict(zip(parts, summed.tolist(), strict=True))
        return {**numbers, "learning_rate": self.optimizer.param_groups[0]["lr"]}

    def _one_step(self) -> dict[str, torch.Tensor]:
        config, step, device = self.config, self.step, self.accelerator.device
        phase = config.phase_at(step)
        rate = learning_rate(
            step, config.peak_learning_rate, config.warm_up_steps, config.num_steps, config.final_share
        )
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        momentum = 0.0 if phase.trains == "products" else config.scale_momentum_at(step)
        self.model.conditioning.texture.requires_grad_(phase.trains != "diffusion")
        parts = self.stream.at(step, self.items_at)
        batches = [type(part.batch)(*(tensor.to(device) for tensor in part.batch)) for part in parts]
        block = self.accelerator.unwrap_model(self.objective).latent_block
        totals = step_totals(batches, block, config.loss.outside, self.accelerator.num_processes)
        added: dict[str, torch.Tensor] = {}
        for index, (batch, part) in enumerate(zip(batches, parts, strict=True)):
            is_last = index == len(parts) - 1
            with nullcontext() if is_last else self.accelerator.no_sync(self.objective):
                with autocast(device, config.execution.precision):
                    loss, here = self.objective(batch, part.draws, totals, phase.trains != "products", momentum)
                self.accelerator.backward(loss)
            added = {name: added.get(name, 0) + value for name, value in here.items()}
        self.accelerator.clip_grad_norm_(self.model.parameters(), 1.0)
        self.prepared.step()
        self.prepared.zero_grad()
        self.average.update(self.model, lambda name: config.steps_trained(name, step))
        self.step += 1
        return added

    def items_at(self, step: int) -> list[TrainingItem] | None:
        """Items of a step's size; None where the present phase's size is another and must stay in memory."""
        if step >= self.config.num_steps:
            return None
        size = self.config.phase_at(step).size
        if size not in self.items:
            if step > 0 and step != self.step:
                return None
            self.items = {size: load_items(self.pairs, size)}
            if self.accelerator.is_main_process:
                say(f"{len(self.items[size])} training items at {size} pixels")
        return self.items[size]

    def validate(self, num_pairs: int) -> dict[str, Any]:
        """Scores and a picture grid of the averaged weights on held-out items."""
        step, phase = self.step, self.config.phase_at(max(0, self.step - 1))
        items = load_items(self.held_out, phase.size)
        with self.average.inside(self.model), autocast(self.accelerator.device, self.config.execution.precision):
            scores, images = evaluate(self.model, items, num_pairs)
        rows = [torch.cat(list(images[name][:12].clamp(0, 1)), -1) for name in _GRID_ROWS if name in images]
        grid = torch.cat(rows, 1).permute(1, 2, 0).cpu().numpy()
        write_png(self.out / "validation" / f"{step:06d}.png", grid)
        write_json(self.out / "validation" / f"{step:06d}.json", {"step": step, "size": phase.size, "scores": scores})
        psnr = {name: score["psnr"] for name, score in scores.items() if "psnr" in score}
        if self.log is not None:
            self.log.write("validation", step, psnr)
            self.log.picture("held-out", step, grid)
        say(f"step {step}, PSNR: " + json.dumps({name: round(value, 2) for name, value in psnr.items()}))
        return scores
