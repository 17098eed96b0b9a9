"""Signed distance and its gradient on a GPU, in Triton: the twin of `surface_kernel` for many points at once.

Unlike there, the Jacobian J of the hash grid is never formed, only products with it. Per point, with W the first layer
as torch holds it, w the last one, s the slope of the softplus, and incoming g (distance) and v (gradient):

    distance = w . softplus(W x + b)    p = W^T (s w)    gradient = J^T p    q = J v.

Kernels of two kinds pass arrays of one number per point and feature. Those of the grid take 128 points at one level, a
thread each (`surface_grid_triton`): `gather` reads x, or q, `slopes` sums J^T p, `scatter` adds to the table's
gradient. Those of the layers take tiles of points with all their features through products with W. Features lie level
by level, [levels, points, features], so that the first kind reads and writes without gaps. Weights of levels are
multiplied into W, outside of all this.

Bytes per point, with L levels of F features, to and from memory, and look-ups, of which entries (some 190 for F = 4 at
each level) should come from L2:

    forward   x written, then read; p written, then read; gradients of levels written, then read     L (16 F + 24)
    backward  x, q, p and the gradient of x, each written or read, q and the last one both           L (24 F)

That is 1.8 kB where the Jacobian written, weighted and multiplied makes some 7 kB, for the surface of the paper preset
(10 levels, F = 4). Kept from forward to backward: x and p, 320 bytes. Sums over levels, and those of layers' gradients
over programs, come afterwards: only the table's gradient takes atomics, all else repeats to the bit.

Products of float32 are three of TensorFloat-32 on tensor cores, which round as float32 does but for a bit or two (3e-7
of the readable twin, measured). Those without tensor cores ("ieee") read operands from shared memory for every few
multiplications: by count of instructions several times slower. On an H200, at the paper's sizes, forward and backward
of 532 thousand points take 3.3 ms, of which the layers are 1.3.
"""

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import FunctionCtx

from illuminerf.fields.hash_grid_triton import OPTIONS, POINTS_PER_PROGRAM, current, level_rows, trouble_with
from illuminerf.fields.surface_grid_triton import gather, scatter, slopes

WIDEST = 64
"""Most features, and most hidden units, that the kernels of the layers are made for."""
# measured on an H200; with eight warps the backward kernel takes 1.46 ms instead of 1.00
TILE = 32
LAYER_OPTIONS = {"num_warps": 4, "num_stages": 2, "enable_fp_fusion": True}
_MOST_PARTS = 528
"""Programs that sum gradients of the layers: four for each multiprocessor of an H100 or H200."""
_SHARPNESS = tl.constexpr(100.0)
PRECISION = "ieee" if torch.version.hip else "tf32x3"


@triton.jit
@no_type_check
def _softplus_with_slope(value):
    tail = tl.exp(tl.abs(value) * -_SHARPNESS)
    slope = 1 / (1 + tail)
    return tl.maximum(value, 0.0) + tl.log(1 + tail) / _SHARPNESS, tl.where(value > 0, slope, tail * slope)


@triton.jit
@no_type_check
def _columns(point, column, num_points, num_features: tl.constexpr):
    place = (column // num_features)[None, :].to(tl.int64) * num_points + point[:, None]
    return place * num_features + (column % num_features)[None, :]


@triton.jit(do_not_specialize=["num_points"])
@no_type_check
def _layers_forward(
    features,
    weight,
    bias,
    last,
    distance,
    by_feature,
    num_points,
    num_features: tl.constexpr,
    width: tl.constexpr,
    num_hidden: tl.constexpr,
    padded_width: tl.constexpr,
    padded_hidden: tl.constexpr,
    with_gradient: tl.constexpr,
    block: tl.constexpr,
    precision: tl.constexpr,
):
    point = tl.program_id(0) * block + tl.arange(0, block)
    column, unit = tl.arange(0, padded_width), tl.arange(0, padded_hidden)
    place = _columns(point, column, num_points, num_features)
    kept = (point < num_points)[:, None] & (column < width)[None, :]
    is_weight = (unit < num_hidden)[:, None] & (column < width)[None, :]
    first = tl.load(weight + unit[:, None] * width + column[None, :], mask=is_weight, other=0.0)
    weights = tl.load(last + unit, mask=unit < num_hidden, other=0.0)
    value = tl.load(features + place, mask=kept, other=0.0)
    before = tl.dot(value, tl.trans(first), input_precision=precision, out_dtype=value.dtype)
    before += tl.load(bias + unit, mask=unit < num_hidden, other=0.0)[None, :]
    hidden, slope = _softplus_with_slope(before)
    tl.store(distance + point, tl.sum(hidden * weights[None, :], axis=1), mask=point < num_points)
    if with_gradient:
        slope *= weights[None, :]
        found = tl.dot(slope, first, input_precision=precision, out_dtype=value.dtype)
        tl.store(by_feature + place, found, mask=kept)


@triton.jit(do_not_specialize=["num_points"])
@no_type_check
def _layers_backward(
    features,
    along,
    weight,
    bias,
    last,
    distance_grad,
    features_grad,
    weight_grads,
    vector_grads,
    num_points,
    num_features: tl.constexpr,
    width: tl.constexpr,
    num_hidden: tl.constexpr,
    padded_width: tl.constexpr,
    padded_hidden: tl.constexpr,
    block: tl.constexpr,
    precision: tl.constexpr,
):
    part = tl.program_id(0)
    column, unit = tl.arange(0, padded_width), tl.arange(0, padded_hidden)
    is_weight = (unit < num_hidden)[:, None] & (column < width)[None, :]
    at_weight = unit[:, None] * width + column[None, :]
    weights = tl.load(last + unit, mask=unit < num_hidden, other=0.0)
    biases = tl.load(bias + unit, mask=unit < num_hidden, other=0.0)
    first_grad = tl.zeros((padded_hidden, padded_width), weight.dtype.element_ty)
    bias_grad = tl.zeros((padded_hidden,), weight.dtype.element_ty)
    last_grad = bias_grad
    for tile in range(part, tl.cdiv(num_points, block), tl.num_programs(0)):
        point = tile * block + tl.arange(0, block)
        place = _columns(point, column, num_points, num_features)
        kept = (point < num_points)[:, None] & (column < width)[None, :]
        # here and not before the loop, where its operands for all products would take registers throughout
        first = tl.load(weight + at_weight, mask=is_weight, other=0.0)
        value = tl.load(features + place, mask=kept, other=0.0)
        rates = tl.load(along + place, mask=kept, other=0.0)
        before = tl.dot(value, tl.trans(first), input_precision=precision, out_dtype=value.dtype)
        hidden, slope = _softplus_with_slope(before + biases[None, :])
        to_slope = tl.dot(rates, tl.trans(first), input_precision=precision, out_dtype=value.dtype)
        incoming = tl.load(distance_grad + point, mask=point < num_points, other=0.0)[:, None]
        last_grad += tl.sum(incoming * hidden + to_slope * slope, axis=0)
        curvature = slope * (1 - slope) * _SHARPNESS
        slope_weighted = slope * weights[None, :]
        to_before = incoming * slope_weighted + to_slope * curvature * weights[None, :]
        bias_grad += tl.sum(to_before, axis=0)
        first_grad = tl.dot(tl.trans(to_before), value, first_grad, input_precision=precision, out_dtype=value.dtype)
        first_grad = tl.dot(
            tl.trans(slope_weighted), rates, first_grad, input_precision=precision, out_dtype=value.dtype
        )
        to_value = tl.dot(to_before, first, input_precision=precision, out_dtype=value.dtype)
        tl.store(features_grad + place, to_value, mask=kept)
    tl.store(weight_grads + part * (num_hidden * width) + at_weight, first_grad, mask=is_weight)
    row = vector_grads + part * (2 * num_hidden) + unit
    tl.store(row, bias_grad, mask=unit < num_hidden)
    tl.store(row + num_hidden, last_grad, mask=unit < num_hidden)


class FusedSurface(torch.autograd.Function):
    """Distance [points] and gradient [points, 3], differentiable in the table and the layers, not in the positions."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, table: Tensor, weight: Tensor, bias: Tensor, last: Tensor, positions: Tensor,
        layout: np.ndarray, level_weights: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """`weight` [hidden, width] and `last` [1, hidden] as torch's linear layers hold them."""
        positions, levels, columns = _placed(table, positions, layout, level_weights)
        features, by_feature = (table.new_empty(len(levels), len(positions), table.shape[1]) for _ in range(2))
        gradients = table.new_empty(len(levels), 3, len(positions))
        layers = (weight * columns, bias, last)
        with current(table):
            _gathered(positions, table, levels, features)
            distance = _distances(features, layers, by_feature)
            slopes[_programs(features)](
                positions, table, levels, by_feature, gradients, len(positions), *_sizes(table), **OPTIONS
            )
        ctx.save_for_backward(positions, levels, columns, table, *layers, features, by_feature)
        return distance, gradients.sum(0).T.contiguous()

    @staticmethod
    def backward(ctx, distance_grad: Tensor, gradient_grad: Tensor):  # type: ignore[no-untyped-def]
        """Gradients of table, weight, bias and last layer."""
        positions, levels, columns, table, *layers, features, by_feature = ctx.saved_tensors
        distance_grad, gradient_grad = distance_grad.contiguous(), gradient_grad.contiguous()
        along, features_grad = torch.empty_like(features), torch.empty_like(features)
        num_parts = min(triton.cdiv(len(positions), TILE), _MOST_PARTS)
        weight_grads = table.new_empty(num_parts, *layers[0].shape)
        vector_grads = table.new_empty(num_parts, 2, len(layers[0]))
        table_grad = torch.zeros_like(table)
        with current(table):
            _gathered(positions, table, levels, along, gradient_grad)
            _layers_backward[(num_parts,)](
                features, along, *layers, distance_grad, features_grad, weight_grads, vector_grads, len(positions),
                *_layer_sizes(features, layers), TILE, PRECISION, **LAYER_OPTIONS
            )  # fmt: skip
            scatter[_programs(features)](
                positions, table_grad, levels, features_grad, by_feature, gradient_grad, len(positions),
                *_sizes(table), **OPTIONS
            )  # fmt: skip
        bias_grad, last_grad = vector_grads.sum(0)
        return table_grad, weight_grads.sum(0) * columns, bias_grad, last_grad[None], None, None, None


def distance_alone(
    table: Tensor, weight: Tensor, bias: Tensor, last: Tensor, positions: Tensor, layout: np.ndarray,
    level_weights: Tensor,
) -> Tensor:  # fmt: skip
    """The distance of `FusedSurface`, for those who need no derivative of any kind."""
    positions, levels, columns = _placed(table, positions, layout, level_weights)
    features = table.new_empty(len(levels), len(positions), table.shape[1])
    with current(table):
        _gathered(positions, table, levels, features)
        return _distances(features, (weight * columns, bias, last), None)


def why_not(device: torch.device, num_levels: int, num_features: int, num_hidden: int) -> str:
    """What keeps the kernels from running on this device for a surface of these sizes, or ""."""
    shapes = ((8 * num_levels, num_features), (num_hidden, num_levels * num_features), (num_hidden,), (1, num_hidden))
    if max(shapes[1]) > WIDEST:
        return f"layers of {shapes[1][1]} to {shapes[1][0]} are wider than {WIDEST}"
    parameters = [torch.zeros(shape, device=device, requires_grad=True) for shape in shapes]
    layout = np.array([[1, 8, 8 * level] for level in range(num_levels)])
    others = (torch.zeros(1, 3, device=device), layout, torch.ones(num_levels, device=device))
    return trouble_with(lambda: FusedSurface.apply(*parameters, *others))


def _placed(
    table: Tensor, positions: Tensor, layout: np.ndarray, level_weights: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions and levels as kernels take them, and the weight of each of the grid's columns."""
    columns = level_weights.detach().to(table)[:, None].expand(-1, table.shape[1]).reshape(-1)
    levels = level_rows(layout.tobytes(), table.device)
    return positions.detach().to(table.dtype).contiguous(), levels, columns


def _gathered(positions: Tensor, table: Tensor, levels: Tensor, out: Tensor, directions: Tensor | None = None) -> None:
    """Features, or their slopes along a direction for each point."""
    others = (positions, False) if directions is None else (directions, True)
    num_features, padded, block = _sizes(table)
    gather[_programs(out)](
        positions, table, levels, others[0], out, len(positions), num_features, padded, others[1], block, **OPTIONS
    )


def _distances(features: Tensor, layers: tuple[Tensor, Tensor, Tensor], by_feature: Tensor | None) -> Tensor:
    """Distances, and what they change by with each feature where there is room for it."""
    num_points = features.shape[1]
    distance = features.new_empty(num_points)
    found = distance if by_feature is None else by_feature
    _layers_forward[(triton.cdiv(num_points, TILE),)](
        features, *layers, distance, found, num_points, *_layer_sizes(features, layers), by_feature is not None,
        TILE, PRECISION, **LAYER_OPTIONS
    )  # fmt: skip
    return distance


def _programs(features: Tensor) -> tuple[int, int]:
    return triton.cdiv(features.shape[1], POINTS_PER_PROGRAM), features.shape[0]


def _sizes(table: Tensor) -> tuple[int, int, int]:
    return table.shape[1], triton.next_power_of_2(table.shape[1]), POINTS_PER_PROGRAM


def _layer_sizes(features: Tensor, layers: Sequence[Tensor]) -> tuple[int, int, int, int, int]:
    """Products are of 16 numbers at least, and of powers of two."""
    num_hidden, width = layers[0].shape
    padded = (max(16, triton.next_power_of_2(size)) for size in (width, num_hidden))
    return features.shape[2], width, num_hidden, *padded
