"""What a CUDA device computes is what the CPU computes. Run with `pytest -m gpu`."""

import dataclasses

import pytest
import torch

from benchmarks.fields import sphere_pool
from illuminerf.diffusion.sampling import sample_relit
from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.geometry_fit import GeometryLossConfig, geometry_steps
from illuminerf.fields.hash_grid import HashGrid, HashGridConfig
from illuminerf.fields.image_rendering import render_image
from illuminerf.fields.optimisation import OptimiserConfig, Stepper
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.ray_guide import RayGuide
from illuminerf.fields.shell import surface_shell
from illuminerf.fields.step_draws import StepDraws
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.workflow.device import Precision
from tests.diffusion.tiny import random_condition_inputs, tiny_model, with_noise_in_every_weight

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device"),
]
_GRID = HashGridConfig(num_levels=4, num_features=2, log2_entries=7, coarsest=3, finest=24)


def test_hash_grid_and_the_gradient_of_its_table() -> None:
    grid = HashGrid(_GRID, torch.Generator().manual_seed(0)).double()
    positions = torch.rand(500, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 1.9 - 0.95
    outputs = []
    for device in ("cpu", "cuda"):
        moved = grid.to(device)
        features, jacobian = moved.with_jacobian(positions.to(device))
        (gradient,) = torch.autograd.grad((features**2).sum() + (jacobian**3).sum(), moved.table)
        outputs.append([tensor.detach().cpu() for tensor in (features, jacobian, gradient)])
    for ours, wanted in zip(outputs[1], outputs[0], strict=True):
        torch.testing.assert_close(ours, wanted, rtol=1e-9, atol=1e-12)
    # the guard: the next cell's features are others
    shifted, _ = grid.with_jacobian((positions + 0.1).to("cuda"))
    assert (shifted.detach().cpu() - outputs[0][0]).abs().max() > 1e-6


def test_an_image_of_a_field() -> None:
    torch.manual_seed(0)
    field = RadianceField(FieldConfig.embedded())
    with torch.no_grad():
        field.appearance.grid.table.normal_()
    camera = turntable_cameras(1, 2.5, 0.6, 24, 32)
    images = []
    for device in ("cpu", "cuda"):
        cells = OccupiedCells(torch.ones(16, 16, 16, dtype=torch.bool, device=device))
        images.append(render_image(field, surface_shell(field.to(device).surface, cells), camera, 0))
    for name, wanted in vars(images[0]).items():
        assert abs(getattr(images[1], name) - wanted).max() < 2e-3, name
    # the guard: pixels differ from each other by more
    assert images[0].srgb.std() > 0.05


def test_signed_distance_of_a_field() -> None:
    config = FieldConfig.embedded()
    config = dataclasses.replace(config, surface=dataclasses.replace(config.surface, grid=_GRID))
    torch.manual_seed(0)
    field = RadianceField(config)
    positions = torch.rand(200, 3) - 0.5
    on_cpu = field.surface.signed_distance(positions)
    on_gpu = field.to("cuda").surface.signed_distance(positions.cuda()).cpu()
    torch.testing.assert_close(on_gpu, on_cpu, rtol=1e-3, atol=1e-4)
    assert on_cpu.std() > 0.01, "all the same would always agree"


def test_samples_of_a_relighting_model() -> None:
    model = with_noise_in_every_weight(tiny_model())
    image, cues = random_condition_inputs(2, 32)
    on_cpu = sample_relit(model, image, cues, [[0], [1]], 2)
    on_gpu = sample_relit(model.to("cuda"), image.cuda(), cues.cuda(), [[0], [1]], 2).cpu()
    torch.testing.assert_close(on_gpu, on_cpu, rtol=0, atol=0.02)
    other = sample_relit(model, image.cuda(), cues.cuda(), [[2], [3]], 2).cpu()
    assert (other - on_cpu).abs().max() > 0.05, "other seeds must give other samples"


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_recorded_steps_are_the_steps(
    precision: Precision, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # of this noise there is as much as slots, so that what is drawn after it depends on their number
    monkeypatch.setattr(StepDraws, "normal", lambda draws, *shape: torch.zeros(*shape, device="cuda"))
    results = []
    for records, seed in ((True, 0), (False, 0), (False, 0), (False, 1)):
        torch.manual_seed(seed)
        field = RadianceField(FieldConfig.embedded()).to("cuda")
        pool = sphere_pool(torch.device("cuda"), 48)
        target = torch.full((len(pool), 3), 0.5, device="cuda")
        alpha = (torch.arange(len(pool), device="cuda") < pool.num_foreground).float()
        optimiser = OptimiserConfig(num_steps=30, rays_per_step=512, warmup_steps=3)
        steps = geometry_steps(field, GeometryLossConfig(), optimiser, pool, target, alpha, RayGuide(pool), seed)
        stepper = Stepper(field.parameters(), optimiser, steps, records=records)
        with field.computing_in(precision):
            results.append([numbers["loss"] for numbers in stepper.run(0, 30)])
    recorded, launched, again, other = results
    assert recorded[:8] == pytest.approx(launched[:8], rel=1e-4)
    # atomics add in any order, and differences grow: as far as between two fits whose steps are launched, or so
    apart = max(abs(one - two) for one, two in zip(launched, again, strict=True))
    assert recorded == pytest.approx(launched, rel=0.02, abs=4 * apart)
    # the guard: other seeds have other losses from the start
    assert other[:8] != pytest.approx(launched[:8], rel=1e-4)
    assert "cannot be recorded" not in capsys.readouterr().err
