"""The multi-resolution hash grid on a GPU, in Triton: the fast twin of `hash_grid.interpolate`.

One program takes 128 points at one level: a point per thread, its features in one vector (16 bytes for four). Levels
are the slow axis of the grid, so that programs which run together read one level's entries, which then stay in the L2
cache (32 MB at 2^21 entries of four features; 50 MB on an H100 or H200).

Bytes per point and level, with F features: the position (12, from L2), eight entries in sectors of 32 bytes (x and
x + 1 share one half of the time: some 190 for F = 4, from L2 but for the first touch) and the outputs, 4 F for the
features and 12 F for the Jacobian, which have to reach memory. So the floor of a forward pass with the Jacobian is

    (levels * entries * 4 F  +  points * levels * 16 F) bytes / bandwidth,

0.7 GB for the surface of the paper preset (540 thousand points, 10 levels, F = 4), 0.2 ms at 4 TB/s. Backward reads the
incoming gradients (16 F), writes zeros to the table's gradient and adds to it: eight vectors per point and level,
by atomics which the L2 carries out. They add in any order, so two runs differ by rounding.

`TRITON_INTERPRET=1`, set before the import, runs the kernels on CPU tensors, slowly: for tests.
"""

import contextlib
import functools
from collections.abc import Callable
from typing import no_type_check

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import FunctionCtx

POINTS_PER_PROGRAM = 128
# multiply and add stay two roundings as in the twin: fused, points on the border of two cells would change sides
OPTIONS = {"num_warps": 4, "enable_fp_fusion": False}


@triton.jit
@no_type_check
def _cell(positions, row, exists, axis: tl.constexpr, half, last):
    position = tl.load(positions + row * 3 + axis, mask=exists, other=0.0)
    scaled = tl.minimum(tl.maximum(position * half + half, 0.0), half + half)
    corner = tl.minimum(scaled.to(tl.int32), last)
    return corner.to(tl.uint32), scaled - corner.to(scaled.dtype)


@triton.jit
@no_type_check
def _level_of(levels, level):
    """Resolution, first entry, hash mask, stored densely or not, of a row of `level_rows`."""
    row = levels + level * 4
    return tl.load(row), tl.load(row + 1), tl.load(row + 2).to(tl.uint32), tl.load(row + 3) != 0


@triton.jit
@no_type_check
def _cells(positions, row, exists, resolution, half):
    """The cells that points lie in, and where in them, from 0 to 1 along each axis."""
    x, fx = _cell(positions, row, exists, 0, half, resolution - 1)
    y, fy = _cell(positions, row, exists, 1, half, resolution - 1)
    z, fz = _cell(positions, row, exists, 2, half, resolution - 1)
    return x, y, z, fx, fy, fz


@triton.jit
@no_type_check
def own_points(positions, table, levels, num_points, block: tl.constexpr):
    """What a program works on: its level, the rows of its points, which exist, half the level's resolution, what
    `entries` asks of their cells, and where in their cells they lie."""
    level = tl.program_id(1)
    resolution, offset, hash_mask, is_dense = _level_of(levels, level)
    point = tl.program_id(0) * block + tl.arange(0, block)
    exists, row = point < num_points, point.to(tl.int64)
    half = resolution.to(table.dtype.element_ty) * 0.5
    x, y, z, fx, fy, fz = _cells(positions, row, exists, resolution, half)
    cell = (x, y, z, resolution, offset, hash_mask, is_dense)
    return level, row, exists, half, cell, fx, fy, fz


@triton.jit
@no_type_check
def corner_weights(corner: tl.constexpr, fx, fy, fz):
    """Of one of a cell's eight corners, along each axis; bits of the number are x, y and z."""
    wx = fx if corner & 1 else 1 - fx
    wy = fy if corner & 2 else 1 - fy
    wz = fz if corner & 4 else 1 - fz
    return wx, wy, wz


@triton.jit
@no_type_check
def entries(corner: tl.constexpr, x, y, z, resolution, offset, hash_mask, is_dense):
    """Rows of the table for one corner of cells; the compiler takes what corners share out of their loop."""
    # 32 bits wrap, which leaves the low ones as they are in the twin's 64
    side, hash_y, hash_z = (resolution + 1).to(tl.uint32), y * 2654435761, z * 805459861
    hashed = hash_y + 2654435761 if corner & 2 else hash_y
    hashed ^= hash_z + 805459861 if corner & 4 else hash_z
    hashed ^= x + 1 if corner & 1 else x
    dense = x + side * (y + side * z) + side * ((corner & 2) // 2 + side * (corner // 4)) + (corner & 1)
    return offset.to(tl.int64) + tl.where(is_dense, dense, hashed & hash_mask).to(tl.int64)


@triton.jit(do_not_specialize=["num_points"])
@no_type_check
def _forward(
    positions,
    table,
    levels,
    features,
    jacobian,
    num_points,
    num_features: tl.constexpr,
    padded: tl.constexpr,
    with_jacobian: tl.constexpr,
    block: tl.constexpr,
):
    level, row, exists, half, cell, fx, fy, fz = own_points(positions, table, levels, num_points, block)
    feature = tl.arange(0, padded)
    kept = exists[:, None] & (feature < num_features)[None, :]
    value = tl.zeros((block, padded), table.dtype.element_ty)
    slope_x, slope_y, slope_z = value, value, value
    for corner in tl.static_range(8):
        wx, wy, wz = corner_weights(corner, fx, fy, fz)
        entry = entries(corner, *cell)
        stored = tl.load(table + entry[:, None] * num_features + feature[None, :], mask=kept, other=0.0)
        value += (wx * wy * wz)[:, None] * stored
        if with_jacobian:
            by_x, by_y, by_z = wy * wz * half, wx * wz * half, wx * wy * half
            slope_x += (by_x if corner & 1 else -by_x)[:, None] * stored
            slope_y += (by_y if corner & 2 else -by_y)[:, None] * stored
            slope_z += (by_z if corner & 4 else -by_z)[:, None] * stored
    width = tl.num_programs(1) * num_features
    column = (level * num_features + feature)[None, :]
    tl.store(features + row[:, None] * width + column, value, mask=kept)
    if with_jacobian:
        start = jacobian + row[:, None] * 3 * width + column
        tl.store(start, slope_x, mask=kept)
        tl.store(start + width, slope_y, mask=kept)
        tl.store(start + 2 * width, slope_z, mask=kept)


@triton.jit(do_not_specialize=["num_points"])
@no_type_check
def _backward(
    positions,
    table_grad,
    levels,
    features_grad,
    jacobian_grad,
    num_points,
    row_stride,
    column_stride,
    axis_stride,
    num_features: tl.constexpr,
    padded: tl.constexpr,
    with_jacobian: tl.constexpr,
    block: tl.constexpr,
):
    level, row, exists, half, cell, fx, fy, fz = own_points(positions, table_grad, levels, num_points, block)
    feature = tl.arange(0, padded)
    kept = exists[:, None] & (feature < num_features)[None, :]
    column = (level * num_features + feature)[None, :]
    to_value = tl.load(
        features_grad + row[:, None] * (tl.num_programs(1) * num_features) + column, mask=kept, other=0.0
    )
    if with_jacobian:
        start = jacobian_grad + row[:, None] * row_stride + column * column_stride
        to_x = tl.load(start, mask=kept, other=0.0) * half
        to_y = tl.load(start + axis_stride, mask=kept, other=0.0) * half
        to_z = tl.load(start + 2 * axis_stride, mask=kept, other=0.0) * half
    for corner in tl.static_range(8):
        wx, wy, wz = corner_weights(corner, fx, fy, fz)
        entry = entries(corner, *cell)
        share = (wx * wy * wz)[:, None] * to_value
        if with_jacobian:
            share += (wy * wz if corner & 1 else -(wy * wz))[:, None] * to_x
            share += (wx * wz if corner & 2 else -(wx * wz))[:, None] * to_y
            share += (wx * wy if corner & 4 else -(wx * wy))[:, None] * to_z
        tl.atomic_add(table_grad + entry[:, None] * num_features + feature[None, :], share, mask=kept, sem="relaxed")


class TritonInterpolation(torch.autograd.Function):
    """`KernelInterpolation` on a GPU: differentiable in the table, not in the positions."""

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx: FunctionCtx, table: Tensor, positions: Tensor, layout, with_jacobian: bool
    ) -> tuple[Tensor, Tensor]:
        """Returns features [points, levels * features] and, where asked, the Jacobian [.., 3] (else empty)."""
        positions = positions.detach().to(table.dtype).contiguous()
        levels = level_rows(layout.tobytes(), table.device)
        columns = len(levels) * table.shape[1]
        features = table.new_empty(len(positions), columns)
        # axes before columns, so that a thread writes its features in one go
        jacobian = table.new_empty(len(positions) if with_jacobian else 0, 3, columns)
        constants = _constants(table, with_jacobian)
        with current(table):
            _forward[_programs(positions, levels)](
                positions, table, levels, features, jacobian, len(positions), *constants, **OPTIONS
            )
        ctx.save_for_backward(positions, levels)
        ctx.table_shape, ctx.with_jacobian = table.shape, with_jacobian  # type: ignore[attr-defined]
        return features, jacobian.transpose(1, 2)

    @staticmethod
    def backward(ctx, features_grad: Tensor, jacobian_grad: Tensor):  # type: ignore[no-untyped-def]
        """Gradient of the table."""
        positions, levels = ctx.saved_tensors
        table_grad = torch.zeros(ctx.table_shape, dtype=positions.dtype, device=positions.device)
        grads = (features_grad.contiguous(), jacobian_grad)
        constants = _constants(table_grad, ctx.with_jacobian)
        with current(table_grad):
            _backward[_programs(positions, levels)](
                positions, table_grad, levels, *grads, len(positions), *jacobian_grad.stride(), *constants, **OPTIONS
            )
        return table_grad, None, None, None


def why_not(device: torch.device) -> str:
    """What keeps the kernels from running on this device (Triton needs a C compiler at run time), or ""."""
    table, positions = torch.zeros(8, 2, device=device, requires_grad=True), torch.zeros(1, 3, device=device)
    return trouble_with(lambda: TritonInterpolation.apply(table, positions, np.array([[1, 8, 0]]), True))


def trouble_with(outputs: Callable[[], tuple[Tensor, ...]]) -> str:
    """What keeps outputs, or their gradients, from being computed by kernels, in a line; or ""."""
    try:
        with torch.enable_grad():
            sum(output.sum() for output in outputs()).backward()  # type: ignore[union-attr]
    except Exception as error:  # whatever it is, here and in Triton's own code: the readable twin runs everywhere
        return f"{type(error).__name__}: {error}".splitlines()[0]
    return ""


@functools.lru_cache(maxsize=64)
def level_rows(layout: bytes, device: torch.device) -> Tensor:
    """`kernel_layout` in the form the kernels take: resolution, first entry, hash mask, stored densely or not."""
    rows = [
        [resolution, offset, size - 1, int((resolution + 1) ** 3 <= size)]
        for resolution, size, offset in np.frombuffer(layout, np.int64).reshape(-1, 3).tolist()
    ]
    return torch.tensor(rows, dtype=torch.int32, device=device)


def _programs(positions: Tensor, levels: Tensor) -> tuple[int, int]:
    return triton.cdiv(len(positions), POINTS_PER_PROGRAM), len(levels)


def _constants(table: Tensor, with_jacobian: bool) -> tuple[int, int, bool, int]:
    return table.shape[1], triton.next_power_of_2(table.shape[1]), with_jacobian, POINTS_PER_PROGRAM


def current(tensor: Tensor) -> contextlib.AbstractContextManager[object]:
    """Triton launches on the current device, whatever the tensors are on."""
    return torch.cuda.device(tensor.device) if tensor.is_cuda else contextlib.nullcontext()
