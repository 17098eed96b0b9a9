"""The Triton kernels against the readable twin in float64, by Triton's interpreter where there is no GPU."""

import ast
import importlib.util
from pathlib import Path

import pytest
import torch
from torch import Tensor

from illuminerf.fields import hash_grid
from illuminerf.fields.hash_grid import HashGrid, interpolate
from tests.fields.triton_cases import _OUTSIDE, CASES, Case, answers, eikonal_gradients
from tests.fields.triton_processes import check_compiling, interpreted, needs_triton


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Tensor]]:
    """What the kernels answer, by case."""
    return interpreted("triton_cases.py", tmp_path_factory.mktemp("triton"))


def twin(grid: HashGrid, positions: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor]:
    return interpolate(positions, grid.table, grid._resolutions, grid._sizes, grid._offsets, with_jacobian)


def wanted(case: Case) -> dict[str, Tensor]:
    return answers(case, torch.float64, twin)


def errors(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> dict[str, float]:
    """Largest difference over largest value."""
    return {key: float((ours[key].double() - value).abs().max() / value.abs().max()) for key, value in theirs.items()}


def tolerance(case: Case) -> float:
    """Against float64. A float32 position is known to 1.4e-6 of a cell where there are 32 (half a unit of the product,
    of 8 to 16, and of the sum, of 16 to 32); along three axes, each by at most twice the largest entry: 9e-6."""
    return 1e-13 if case.dtype == torch.float64 else 1e-5


_FLOAT32 = "whole block and one more, float32"
_SUMS = 2e-6  # an entry's gradient sums some 30 numbers, each rounded by 6e-8


@needs_triton
@pytest.mark.parametrize("name", CASES)
def test_kernels_equal_the_twin(found: dict[str, dict[str, Tensor]], name: str) -> None:
    """Values, Jacobian, first derivatives and those of a loss on normals, which are of second order."""
    for key, error in errors(found[name], wanted(CASES[name])).items():
        assert error < tolerance(CASES[name]), key


@needs_triton
@pytest.mark.parametrize("name", CASES)
def test_other_positions_are_noticed(found: dict[str, dict[str, Tensor]], name: str) -> None:
    """The guard of the tolerance."""
    case = CASES[name]
    moved = Case(case.num_features, case.positions * 0.999, case.dtype)
    for key, error in errors(found[name], wanted(moved)).items():
        assert error > 100 * tolerance(case), key


def test_the_twin_in_float32_is_as_far_from_float64_as_the_kernels_may_be() -> None:
    """What the tolerance is for: the rounding of positions, which is nobody's fault."""
    case = CASES[_FLOAT32]
    errors_of_twin = errors(answers(case, torch.float32, twin), wanted(case))
    assert 2e-7 < max(errors_of_twin.values()) < tolerance(case)


@needs_triton
def test_kernels_round_positions_as_the_twin_does(found: dict[str, dict[str, Tensor]]) -> None:
    """In float32 only the order of sums is left between them; positions a few units in the last place away are not."""
    case = CASES[_FLOAT32]
    of_sums = errors(found[_FLOAT32], answers(case, torch.float32, twin))
    assert max(of_sums.values()) < _SUMS
    moved = Case(case.num_features, case.positions * (1 + 1e-5), case.dtype)
    assert min(errors(found[_FLOAT32], answers(moved, torch.float32, twin)).values()) > 2 * _SUMS


@needs_triton
def test_another_hash_is_noticed_on_the_hashed_level_alone(
    found: dict[str, dict[str, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "three features, odd borders"
    monkeypatch.setattr(hash_grid, "_PRIMES", (1, 2654435761, 805459863))
    ours, theirs = found[name]["features"], wanted(CASES[name])["features"]
    torch.testing.assert_close(ours[:, :3], theirs[:, :3], rtol=0, atol=1e-12)
    assert (ours[:, 3:] - theirs[:, 3:]).abs().max() > 0.1


@needs_triton
def test_an_eikonal_loss_trains_a_surface_through_the_kernels(found: dict[str, dict[str, Tensor]]) -> None:
    """As on a GPU where the surface's own kernels do not fit: normals in forward mode, one backward pass."""
    assert max(errors(found["eikonal"], eikonal_gradients(twin)).values()) < 1e-12
    # the guard: a tenth less of the eikonal term, the one of second order, shows in every gradient
    assert min(errors(found["eikonal"], eikonal_gradients(twin, weight=0.9)).values()) > 1e-3


@needs_triton
def test_points_outside_are_clamped_and_borders_belong_to_the_next_cell(found: dict[str, dict[str, Tensor]]) -> None:
    name = "three features, odd borders"
    case, ours = CASES[name], found[name]
    inside = Case(3, _OUTSIDE.clamp(-1, 1))
    for key in ("features", "jacobian"):
        torch.testing.assert_close(ours[key][-3:], wanted(inside)[key], rtol=0, atol=1e-12)
    # the guard: a hair before the border, in the cell before it, the Jacobian is another one
    before = wanted(Case(3, case.positions.double() - 1e-12))["jacobian"]
    assert (ours["jacobian"][20:34] - before[20:34]).abs().max() > 1


def test_without_triton_the_twin_is_used_and_said_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert hash_grid._gpu_kernel.__wrapped__(torch.device("cuda")) is None
    assert "pip install triton" in capsys.readouterr().err


@needs_triton
def test_what_keeps_kernels_from_running_is_said_in_a_line() -> None:
    from triton.runtime.errors import OutOfResources

    from illuminerf.fields.hash_grid_triton import trouble_with

    def fails(error: Exception) -> tuple[torch.Tensor, ...]:
        raise error

    assert "shared memory" in trouble_with(lambda: fails(OutOfResources(200, 100, "shared memory")))
    assert trouble_with(lambda: fails(RuntimeError("no driver\nat all"))) == "RuntimeError: no driver"
    assert trouble_with(lambda: fails(TypeError("in Triton"))) == "TypeError: in Triton"
    assert trouble_with(lambda: (torch.zeros(2, requires_grad=True),)) == ""


@pytest.mark.parametrize("name", ["hash_grid_triton", "surface_grid_triton", "surface_triton"])
def test_no_kernel_unpacks_a_tuple_within_a_tuple(name: str) -> None:
    """Triton 3.7, which PyTorch 2.13 brings along, fails at it; 3.2 and 3.9 do not."""
    found = importlib.util.find_spec("illuminerf")
    assert found is not None and found.origin is not None
    assert not nested_targets((Path(found.origin).parent / "fields" / f"{name}.py").read_text())
    # the guard
    assert nested_targets("def kernel():\n    a, (b, c) = own_points()")


def nested_targets(source: str) -> list[int]:
    """Lines of functions' assignments to a tuple within a tuple."""
    assigned = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Assign)]
    tuples = [target for node in assigned for target in node.targets if isinstance(target, ast.Tuple)]
    return [target.lineno for target in tuples if any(isinstance(part, ast.Tuple) for part in target.elts)]


_COMPILE = """
import itertools, sys
import illuminerf
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile
from illuminerf.fields import hash_grid_triton as kernels
kinds = [("fp32", 2, True), ("fp32", 2, False), ("fp32", 3, True), ("fp32", 4, True), ("fp64", 2, True)]
for kernel, (dtype, features, jacobian) in itertools.product((kernels._forward, kernels._backward), kinds):
    padded, block = 2 * -(-features // 2), 100 if sys.argv[1] == "spoilt" else 128
    constants = {"num_features": features, "padded": padded, "with_jacobian": jacobian, "block": block}
    types = dict.fromkeys(kernel.arg_names, "*" + dtype) | {"levels": "*i32"} | dict.fromkeys(constants, "constexpr")
    types |= {name: "i32" for name in types if name == "num_points" or name.endswith("stride")}
    places = {(kernel.arg_names.index(name),): value for name, value in constants.items()}
    compiled = compile(ASTSource(kernel, types, places), target=GPUTarget("cuda", 90, 32), options=kernels.OPTIONS)
    assert len(compiled.asm["cubin"]) > 1000
print("compiled")
"""


@needs_triton
@pytest.mark.parametrize("state", ["good", "spoilt"])
def test_kernels_compile_for_a_gpu_that_is_not_here(tmp_path: Path, state: str) -> None:
    """The interpreter takes more than the compiler does. Spoilt: blocks that are no power of two."""
    check_compiling(_COMPILE, state, tmp_path)
