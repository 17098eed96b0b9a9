"""The surface's Triton kernels against the readable twin in float64, by Triton's interpreter where there is no GPU."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from illuminerf.fields import hash_grid, surface_kernel
from illuminerf.fields import surface as surface_module
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.surface import SurfaceConfig, SurfaceField, SurfacePoint
from tests.fields.surface_triton_cases import CASES, Case, answers, by_twins
from tests.fields.triton_processes import check_compiling, interpreted, needs_triton


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Tensor]]:
    """What the kernels answer, by case."""
    return interpreted("surface_triton_cases.py", tmp_path_factory.mktemp("triton"))


def wanted(case: Case) -> dict[str, Tensor]:
    with by_twins():
        return answers(case, torch.float64)


def errors(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> dict[str, float]:
    """Largest difference over largest value."""
    return {key: float((ours[key].double() - value).abs().max() / value.abs().max()) for key, value in theirs.items()}


def tolerance(case: Case) -> float:
    """In float32 the sharpness of 100 enlarges what values before the softplus are rounded by, 3e-8."""
    return 1e-13 if case.dtype == torch.float64 else 2e-6


@needs_triton
@pytest.mark.parametrize("name", CASES)
def test_kernels_equal_the_twin(found: dict[str, dict[str, Tensor]], name: str) -> None:
    """Values, with and without gradients, and derivatives, of the gradient too, in table and layers."""
    for key, error in errors(found[name], wanted(CASES[name])).items():
        assert error < tolerance(CASES[name]), key
    # the guard: positions a thousandth away are told apart by everything
    moved = wanted(dataclasses.replace(CASES[name], shrunk=0.999))
    for key, error in errors(found[name], moved).items():
        assert error > 100 * tolerance(CASES[name]), key


@needs_triton
def test_a_slope_taken_for_a_constant_is_noticed(
    found: dict[str, dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second order: normals change by the curvature of the softplus."""

    def residual(surface: SurfaceField, features: Tensor, jacobian: Tensor) -> SurfacePoint:
        before = surface.hidden(features)
        slope = torch.sigmoid(100 * before).detach() + 0 * before
        by_feature = (slope * surface.head.weight) @ surface.hidden.weight
        distance = functional.softplus(before, beta=100) @ surface.head.weight[0]
        return SurfacePoint(distance, torch.einsum("nf,nfi->ni", by_feature, jacobian))

    monkeypatch.setattr(SurfaceField, "residual", residual)
    for name, case in CASES.items():
        of_wrong = errors(found[name], wanted(case))
        assert of_wrong["distance"] < tolerance(case) and of_wrong["gradient"] < tolerance(case)
        assert min(of_wrong[f"{loss} to {key}"] for loss in ("slopes", "both") for key in ("table", "weight")) > 0.02


@needs_triton
def test_weights_of_levels_are_noticed(found: dict[str, dict[str, Tensor]]) -> None:
    name = "levels fade in"
    other = errors(found[name], wanted(dataclasses.replace(CASES[name], levels=(1.0, 0.6, 0.1))))
    assert other.pop("distances to bias") > 1e-4
    assert min(other.values()) > 1e-4
    # nothing reaches a level of weight 0: its entries, the last 512, and its columns
    assert not found[name]["both to table"][-512:].any() and not found[name]["both to weight"][:, 4:].any()
    assert found[name]["both to table"][:-512].any() and found[name]["both to weight"][:, :4].any()


class _OnGpu(Tensor):
    """Positions that say they are on a GPU."""

    is_cuda = True


@needs_triton
def test_which_kernels_take_a_surface(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from illuminerf.fields import surface_triton

    monkeypatch.setattr(hash_grid, "_gpu_kernel", lambda device: object())
    monkeypatch.setattr(surface_triton, "trouble_with", lambda outputs: "")
    monkeypatch.setattr(surface_module, "_gpu_kernels", surface_module._gpu_kernels.__wrapped__)
    grid = HashGridConfig(2, 4, 8, 3, 12)
    surface, positions = SurfaceField(SurfaceConfig(grid, 24, grid, 4)), torch.zeros(5, 3)
    there = positions.as_subclass(_OnGpu)
    assert surface._kernels(positions) is surface_kernel and surface._kernels(there) is surface_triton
    # the twin takes no points, points in float64, and layers wider than the kernels are made for
    empty, double = torch.zeros(0, 3).as_subclass(_OnGpu), positions.double().as_subclass(_OnGpu)
    assert surface._kernels(empty) is None and surface._kernels(double) is None
    assert [len(part) for part in surface(torch.zeros(0, 3))] == [0, 0]
    wide = SurfaceField(SurfaceConfig(grid, surface_triton.WIDEST + 1, grid, 4))
    assert wide._kernels(there) is None and wide._kernels(positions) is surface_kernel
    assert "layers of 8 to 65 are wider than 64" in capsys.readouterr().err
    monkeypatch.setattr(surface_triton, "trouble_with", lambda outputs: "out of shared memory")
    assert surface._kernels(there) is None
    assert "the surface runs slower than it could on cpu" in (said := capsys.readouterr().err)
    assert "out of shared memory" in said
    # and all points where Triton does not work
    monkeypatch.setattr(hash_grid, "_gpu_kernel", lambda device: None)
    assert surface._kernels(there) is None


_COMPILE = """
import sys
import illuminerf
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile
from illuminerf.fields import surface_grid_triton as grid, surface_triton as surface
features = {"num_features": 4, "padded": 4, "block": 128}
layers = {"num_features": 4, "width": 40, "num_hidden": 64, "padded_width": 64, "padded_hidden": 64}
layers |= {"block": 24 if sys.argv[1] == "spoilt" else surface.TILE, "precision": surface.PRECISION}
for kernel, constants, options in (
    (surface._layers_forward, layers | {"with_gradient": True}, surface.LAYER_OPTIONS),
    (surface._layers_forward, layers | {"with_gradient": False}, surface.LAYER_OPTIONS),
    (surface._layers_backward, layers, surface.LAYER_OPTIONS),
    (grid.gather, features | {"is_slope": False}, surface.OPTIONS),
    (grid.gather, features | {"is_slope": True}, surface.OPTIONS),
    (grid.slopes, features, surface.OPTIONS),
    (grid.scatter, features, surface.OPTIONS),
):
    types = dict.fromkeys(kernel.arg_names, "*fp32") | {"num_points": "i32"} | dict.fromkeys(constants, "constexpr")
    types |= {"levels": "*i32"} if "levels" in types else {}
    places = {(kernel.arg_names.index(name),): value for name, value in constants.items()}
    compiled = compile(ASTSource(kernel, types, places), target=GPUTarget("cuda", 90, 32), options=options)
    # an H100 has 227 KB of shared memory for a program
    assert len(compiled.asm["cubin"]) > 1000 and compiled.metadata.shared < 100_000
print("compiled")
"""


@needs_triton
@pytest.mark.parametrize("state", ["good", "spoilt"])
def test_kernels_compile_for_a_gpu_that_is_not_here(tmp_path: Path, state: str) -> None:
    """At the sizes of the paper preset. Spoilt: tiles that are no power of two."""
    check_compiling(_COMPILE, state, tmp_path)
