"""Steps with fixed slots: the same as without, no question to the device, done again where they overflow.

What is replayed on a GPU is compared there (tests/test_on_gpu.py); here a replay computes once more.
"""

import dataclasses
import traceback
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from illuminerf.fields.geometry_fit import GeometryLossConfig, geometry_steps
from illuminerf.fields.optimisation import OptimiserConfig, Stepper
from illuminerf.fields.radiance_field import RadianceField
from illuminerf.fields.ray_guide import RayGuide
from illuminerf.fields.recorded_steps import RecordableLoss, RecordedSteps
from illuminerf.fields.shading_slots import ShadingSlots
from illuminerf.fields.step_draws import StepDraws
from tests.fields.test_appearance import _FIELD, _pool

_STEPS = 6
_OPTIMISER = OptimiserConfig(num_steps=_STEPS, rays_per_step=32, warmup_steps=1)
_LOSSES = GeometryLossConfig(first_levels=2)


def test_slots_hold_what_is_worth_it_first() -> None:
    is_worth = torch.rand(40, 7, generator=torch.Generator().manual_seed(0)) > 0.6
    wanted, counts = ShadingSlots().choose(is_worth)
    assert counts is None
    for capacity in (len(wanted), len(wanted) + 20, 280):
        slots = ShadingSlots(capacity)
        chosen, counts = slots.choose(is_worth)
        assert counts is not None and slots.overflow is not None and slots.wanted is not None
        assert chosen[: len(wanted)].tolist() == wanted.tolist() and len(chosen) == capacity
        assert counts.tolist() == [1.0] * len(wanted) + [0.0] * (capacity - len(wanted))
        assert len(chosen.unique()) == capacity, "a sample in two slots"
        assert int(slots.wanted) == len(wanted) and not slots.overflow
    slots = ShadingSlots(len(wanted) - 3)
    chosen, _ = slots.choose(is_worth)
    assert slots.overflow == 1 and chosen.tolist() == wanted[:-3].tolist()


def test_room_grows_at_once_and_shrinks_rarely() -> None:
    slots = ShadingSlots()
    slots.fit_to(10_000, 100_000)
    assert slots.capacity == 16384
    for wanted in (16384, 7000):
        slots.fit_to(wanted, 100_000)
        assert slots.capacity == 16384
    slots.fit_to(16385, 100_000)
    assert slots.capacity == 24576
    slots.fit_to(3000, 100_000)
    assert slots.capacity == 4096
    slots.fit_to(90_000, 100_000)
    assert slots.capacity == 100_000


class _Asked(TorchDispatchMode):
    """Collects what a recording could not hold: questions to the device, sizes that follow from data, new constants.

    The kernels of CPUs, which stand here for those of GPUs, may do so.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations: set[str] = set()

    def __torch_dispatch__(self, operation, types, arguments=(), options=None):  # type: ignore[no-untyped-def]
        name = operation.name()
        by_mask = name.startswith("aten::index.") and any(
            index is not None and index.dtype == torch.bool for index in arguments[1]
        )
        forbidden = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "lift_fresh", "repeat_interleave.T")
        is_of_cpu = any("_kernel.py" in frame.filename for frame in traceback.extract_stack())
        if not is_of_cpu and (by_mask or name.removeprefix("aten::").startswith(forbidden)):
            self.operations.add(name)
        return operation(*arguments, **(options or {}))


@pytest.fixture(autouse=True)
def _no_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is as much of it as slots, so that what is drawn after it depends on their number."""
    monkeypatch.setattr(StepDraws, "normal", lambda draws, num_points, columns: torch.zeros(num_points, columns))


def _made() -> tuple[RadianceField, RayGuide, RecordableLoss]:
    torch.manual_seed(0)
    field = RadianceField(dataclasses.replace(_FIELD, num_samples=4, min_weight=0.02))
    with torch.no_grad():
        field.surface.log_beta.fill_(-2.0)  # a haze, of which many samples are worth shading
    pool = _pool(200)
    guide = RayGuide(pool)
    target = torch.rand(len(pool), 3, generator=torch.Generator().manual_seed(1))
    steps = geometry_steps(field, _LOSSES, _OPTIMISER, pool, target, torch.ones(len(pool)), guide, 0)
    return field, guide, steps


@pytest.mark.parametrize("capacity", [None, 100])
def test_a_step_with_fixed_slots_asks_the_device_nothing(capacity: int | None) -> None:
    field, _, steps = _made()
    steps.slots.capacity = capacity
    steps.prepare(_STEPS - 1)
    steps.loss()  # cameras and constants reach the device once
    with _Asked() as asked:
        loss, _ = steps.loss()
        loss.backward()
    # the guard: without a capacity it does
    assert asked.operations == (set() if capacity else {"aten::nonzero", "aten::lift_fresh"})


def _replaying(monkeypatch: pytest.MonkeyPatch, stepper: Stepper, steps: RecordableLoss) -> list[Any]:
    """Makes a stepper run as on a GPU, but that a replay computes anew; the courses that are recorded."""
    stream = SimpleNamespace(wait_stream=lambda other: None)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: stream)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda chosen: nullcontext())

    def record(recorded: RecordedSteps) -> None:
        courses.append(recorded._tried)
        replay = lambda: setattr(recorded, "_row", recorded._computed())  # noqa: E731
        recorded._graph = SimpleNamespace(replay=replay)  # type: ignore[assignment]

    courses: list[Any] = []
    monkeypatch.setattr(RecordedSteps, "_record", record)
    stepper._recorded = stepper._recording(steps, torch.device("cpu"))
    return courses


def _fitted(monkeypatch: pytest.MonkeyPatch, capacity: int | None, replays: bool) -> dict[str, Any]:
    field, guide, steps = _made()
    stepper = Stepper(field.parameters(), _OPTIMISER, steps)
    courses: list[Any] = []
    if replays:
        steps.slots.capacity = capacity
        courses = _replaying(monkeypatch, stepper, steps)
    losses = [numbers["loss"] for numbers in stepper.run(0, _STEPS)]
    parameters = torch.cat([parameter.detach().view(-1) for parameter in field.parameters()])
    return {"losses": losses, "parameters": parameters, "errors": guide.errors, "courses": courses}


def test_a_fit_of_recorded_steps_is_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = _fitted(monkeypatch, None, replays=False)
    for capacity in (None, 5):  # 5: the first step overflows and is done again
        found = _fitted(monkeypatch, capacity, replays=True)
        assert found["losses"] == pytest.approx(wanted["losses"], rel=1e-5)
        torch.testing.assert_close(found["parameters"], wanted["parameters"], rtol=0, atol=2e-4)
        torch.testing.assert_close(found["errors"], wanted["errors"], rtol=0, atol=1e-5)
        assert found["courses"] == [(16, 128)], "guided steps are recorded once"
    # the guard: a fit whose steps overflow is another one
    field, _, steps = _made()
    stepper = Stepper(field.parameters(), _OPTIMISER, steps)
    steps.slots.capacity = 5
    assert next(stepper.run(0, 1))["loss"] != pytest.approx(wanted["losses"][0], rel=3e-4)


def test_steps_that_overflow_in_the_middle_of_a_block_are_done_again(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = _fitted(monkeypatch, None, replays=False)
    field, guide, steps = _made()
    stepper = Stepper(field.parameters(), _OPTIMISER, steps)
    courses = _replaying(monkeypatch, stepper, steps)
    monkeypatch.setattr(ShadingSlots, "fit_to", _fits_tightly)
    losses = [numbers["loss"] for numbers in stepper.run(0, _STEPS)]
    assert len(set(courses)) > 1, "the test needs steps that overflow"
    assert losses == pytest.approx(wanted["losses"], rel=1e-5)
    torch.testing.assert_close(guide.errors, wanted["errors"], rtol=0, atol=1e-5)


def _fits_tightly(slots: ShadingSlots, wanted: int, most: int) -> None:
    """Not a slot more than it takes."""
    slots.capacity = max(wanted, slots.capacity or 0)


def test_a_step_that_overflows_changes_nothing() -> None:
    field, guide, steps = _made()
    before = [parameter.detach().clone() for parameter in field.parameters()]
    stepper = Stepper(field.parameters(), _OPTIMISER, steps)
    for capacity, changes in ((5, False), (128, True)):
        steps.slots.capacity = capacity
        steps.slots.forgive()
        list(stepper.run(_STEPS - 1, _STEPS))
        assert any(not torch.equal(p, old) for p, old in zip(field.parameters(), before, strict=True)) is changes
        assert bool((guide.errors != 1).any()) is changes


def test_what_cannot_be_recorded_is_launched(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    field, _, steps = _made()
    stepper = Stepper(field.parameters(), _OPTIMISER, steps)

    def fails() -> None:
        raise RuntimeError("operation not permitted\nwhen stream is capturing")

    record = RecordedSteps._record
    _replaying(monkeypatch, stepper, steps)
    monkeypatch.setattr(RecordedSteps, "_record", record)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", fails)
    losses = [numbers["loss"] for numbers in stepper.run(0, _STEPS)]
    assert losses == pytest.approx(_fitted(monkeypatch, None, replays=False)["losses"], rel=1e-5)
    assert capsys.readouterr().err.count("cannot be recorded: operation not permitted") == 1
    assert steps.slots.capacity is None
