"""Settings of a training run of the relighting model, of either kind."""

from dataclasses import dataclass, field, replace
from typing import Literal

from illuminerf.diffusion.augmentation import AugmentationConfig
from illuminerf.diffusion.controlled_base import ControlledBaseConfig
from illuminerf.diffusion.objective import LossWeights
from illuminerf.diffusion.relighting_model import RelightingModelConfig
from illuminerf.workflow.device import Precision
from illuminerf.workflow.errors import UserError


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
class MonitoringConfig:
    """What is written on the way; changes no weights."""

    log_steps: int = 10
    """Steps between lines of metrics.jsonl."""
    validation_steps: int = 500
    """Steps between validations: scores and pictures of the averaged weights on held-out items."""
    validation_pairs: int = 16
    """(Input light, target light) pairs per validation."""
    final_pairs: int = 48
    """The same after the last step."""
    tensorboard: bool = False
    """Also write TensorBoard logs (needs the extra `training`)."""

    def __post_init__(self) -> None:
        if min(self.log_steps, self.validation_steps, self.validation_pairs, self.final_pairs) < 1:
            raise UserError("numbers of steps and pairs must be at least 1")


@dataclass(frozen=True)
class ExecutionConfig:
    """How steps are computed."""

    precision: Precision = "float32"
    """bfloat16: matrix products and convolutions in autocast, weights and sums in float32."""
    num_threads: int = 0
    """Threads that make the next steps' examples meanwhile; 0: none. Changes no result."""
    checkpoints_gradients: bool = False
    """Compute the control's activations twice instead of keeping them (models on a base)."""


@dataclass(frozen=True)
class Config:
    """How the relighting model is trained."""

    model: RelightingModelConfig = field(default=RelightingModelConfig())
    """Sizes of the embedded kind's networks."""
    control: ControlledBaseConfig = field(default=ControlledBaseConfig())
    """Where its `base` is named, the paper's kind is trained instead: a control on that frozen base."""
    phases: tuple[Phase, ...] = (
        Phase(1800, 64, "products"),
        Phase(700, 128, "products"),
        Phase(1500, 64, "diffusion"),
        Phase(900, 128),
    )
    """In order. Deviation: the paper trains 150,000 steps at one resolution."""
    batch_size: int = 32
    """Examples per step, over all processes and parts (paper: 512)."""
    accumulation: int = 1
    """Parts of each process's share of a step, one after the other, to save memory."""
    peak_learning_rate: float = 1e-3
    """After warm-up. Deviation: paper 1e-4, for a model a hundred times larger."""
    warm_up_steps: int = 100
    """Linear from 0 (paper: 1000)."""
    final_share: float = 0.3
    """Share of all steps over which the rate falls to 0. Deviation: the paper's stays constant."""
    average_decay: float = 0.999
    """Of the exponential moving average of the weights, which are what is exported."""
    loss: LossWeights = field(default=LossWeights())
    """Terms of the loss (embedded kind)."""
    augmentation: AugmentationConfig = field(default=AugmentationConfig())
    """Variations of the examples."""
    initial_model: str = ""
    """Folder of a model to start from, or "" for fresh weights."""
    checkpoint_seconds: float = 180.0
    """Time between checkpoints."""
    monitoring: MonitoringConfig = field(default=MonitoringConfig())
    """What is written on the way."""
    execution: ExecutionConfig = field(default=ExecutionConfig())
    """How steps are computed."""
    device: str = "auto"
    """Where it runs: auto, cpu or cuda."""
    seed: int = 0
    """Seed of weights, examples and noise."""

    def __post_init__(self) -> None:
        if not self.phases or self.batch_size < 1 or self.accumulation < 1:
            raise UserError("training needs a phase, a batch and an accumulation of at least one")
        if not 0 <= self.average_decay < 1 or self.peak_learning_rate <= 0:
            raise UserError("average_decay must lie in [0, 1) and the learning rate be positive")
        if self.control.base and any(phase.trains != "all" for phase in self.phases):
            raise UserError("a control on a base has no phases that train a part", fix="use phases that train all")

    @staticmethod
    def paper(base: str = "") -> "Config":
        """The paper's training on a base: 150,000 steps of 512 examples at 512x512, 1e-4 after 1000 steps."""
        return Config(
            control=ControlledBaseConfig(base=base),
            phases=(Phase(150_000, 512),),
            batch_size=512,
            peak_learning_rate=1e-4,
            warm_up_steps=1000,
            final_share=0.0,
            average_decay=0.9999,
            augmentation=AugmentationConfig(
                composited_share=0.0, mixture_share=0.0, tint=0.0, exposure=0.0, unknown_shading_share=1.0
            ),
            execution=ExecutionConfig(precision="bfloat16", num_threads=8, checkpoints_gradients=True),
            checkpoint_seconds=1800.0,
        )

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

    def steps_trained(self, name: str, step: int) -> int:
        """For how many steps before `step` the tensor `name` has been trained; negative where its phase is to come."""
        part = "products" if name.startswith("conditioning.texture.") else "diffusion"
        start = 0
        for phase in self.phases:
            if phase.trains in (part, "all"):
                break
            start += phase.num_steps
        return step - start

    def scale_momentum_at(self, step: int) -> float:
        """How fast the latent scales follow: a running mean at first, then slowly, and not in the last third."""
        start = 0
        for phase in self.phases:
            if phase.trains != "products":
                break
            start += phase.num_steps
        return max(0.02, 1 / (1 + step - start)) if step < self.num_steps * 2 / 3 else 0.0

    @property
    def key(self) -> "Config":
        """The config without what changes no result."""
        return replace(
            self,
            monitoring=MonitoringConfig(),
            execution=replace(self.execution, num_threads=0),
            checkpoint_seconds=0.0,
        )
