"""The multi-resolution hash grid on a CPU, in numba: the fast twin of `hash_grid.interpolate`.

Forward runs in parallel over positions. Backward runs in parallel over levels: levels share no table entries, so
no two threads write to the same place, and every sum has one fixed order.
"""

from typing import no_type_check

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import FunctionCtx

_PRIME_Y, _PRIME_Z = np.uint32(2654435761), np.uint32(805459861)
_NUM_PARTS = 4  # of the points of each level: a thread stays with one level, whose table stays in its cache
FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(inline="always")
@no_type_check
def _cell(position, resolution, half):
    # constants would promote float32 to float64 (slower, and cells that differ from the twin's), so none appear
    scaled = min(max(position * half + half, half - half), half + half)
    corner = max(min(np.int32(scaled), np.int32(resolution - 1)), np.int32(0))
    return np.uint32(corner), scaled - corner * (half / half)


@njit(inline="always")
@no_type_check
def _corners(position, level, half):
    """Where a position lies in its cell of one level, and the table's entries at the cell's eight corners.

    Unsigned throughout: numba would ask of every signed index whether it counts from the end.
    """
    resolution, size, offset = level[0], level[1], np.uint32(level[2])
    x, fx = _cell(position[0], resolution, half)
    y, fy = _cell(position[1], resolution, half)
    z, fz = _cell(position[2], resolution, half)
    one, side = np.uint32(1), np.uint32(resolution + 1)
    if (resolution + 1) * (resolution + 1) * (resolution + 1) <= size:
        i000 = offset + x + side * (y + side * z)
        i001 = i000 + side * side
        corners = (i000, i000 + one, i000 + side, i000 + side + one, i001, i001 + one, i001 + side, i001 + side + one)
        return fx, fy, fz, corners
    mask, x1 = np.uint32(size - 1), x + one
    y0, z0 = y * _PRIME_Y, z * _PRIME_Z
    y1, z1 = y0 + _PRIME_Y, z0 + _PRIME_Z
    h00, h10, h01, h11 = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    corners = (
        offset + ((x ^ h00) & mask), offset + ((x1 ^ h00) & mask), offset + ((x ^ h10) & mask),
        offset + ((x1 ^ h10) & mask), offset + ((x ^ h01) & mask), offset + ((x1 ^ h01) & mask),
        offset + ((x ^ h11) & mask), offset + ((x1 ^ h11) & mask),
    )  # fmt: skip
    return fx, fy, fz, corners


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def grid_forward(positions, table, layout, halves, features, jacobian, with_jacobian):
    """Features [points, levels, features] and, where asked, the Jacobian [points, levels, features, 3], level by level.

    In whatever order of memory: with the levels outermost each thread writes one stretch.
    """
    num_points, num_features = positions.shape[0], table.shape[1]
    for job in prange(_NUM_PARTS * layout.shape[0]):
        level, part = job // _NUM_PARTS, job % _NUM_PARTS
        half = halves[level]
        for n in range(part * num_points // _NUM_PARTS, (part + 1) * num_points // _NUM_PARTS):
            fx, fy, fz, (i000, i100, i010, i110, i001, i101, i011, i111) = _corners(positions[n], layout[level], half)
            for f in range(num_features):
                v000, v010, v001, v011 = table[i000, f], table[i010, f], table[i001, f], table[i011, f]
                d00, d10 = table[i100, f] - v000, table[i110, f] - v010
                d01, d11 = table[i101, f] - v001, table[i111, f] - v011
                c00, c10, c01, c11 = v000 + d00 * fx, v010 + d10 * fx, v001 + d01 * fx, v011 + d11 * fx
                c0, c1 = c00 + (c10 - c00) * fy, c01 + (c11 - c01) * fy
                features[n, level, f] = c0 + (c1 - c0) * fz
                if with_jacobian:
                    d0, d1 = d00 + (d10 - d00) * fy, d01 + (d11 - d01) * fy
                    jacobian[n, level, f, 0] = (d0 + (d1 - d0) * fz) * half
                    jacobian[n, level, f, 1] = ((c10 - c00) + ((c11 - c01) - (c10 - c00)) * fz) * half
                    jacobian[n, level, f, 2] = (c1 - c0) * half


@njit(inline="always")
@no_type_check
def _scatter(table_grad, f, corners, fx, fy, fz, g, gx, gy, gz):
    """Add one feature's gradient to its eight corners: the transpose of the interpolation, one axis at a time."""
    i000, i100, i010, i110, i001, i101, i011, i111 = corners
    top, top_x, top_y = g * fz + gz, gx * fz, gy * fz
    low, low_x, low_y = g - top, gx - top_x, gy - top_y
    back, back_x = low * fy + low_y, low_x * fy
    front, front_x = low - back, low_x - back_x
    right = front * fx + front_x
    table_grad[i100, f] += right
    table_grad[i000, f] += front - right
    right = back * fx + back_x
    table_grad[i110, f] += right
    table_grad[i010, f] += back - right
    back, back_x = top * fy + top_y, top_x * fy
    front, front_x = top - back, top_x - back_x
    right = front * fx + front_x
    table_grad[i101, f] += right
    table_grad[i001, f] += front - right
    right = back * fx + back_x
    table_grad[i111, f] += right
    table_grad[i011, f] += back - right


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def grid_backward(positions, table_grad, layout, halves, features_grad, jacobian_grad, with_jacobian):
    """Gradient of the table. Levels share no entries: no two threads write to one place, every sum has one order."""
    num_features = table_grad.shape[1]
    for level in prange(layout.shape[0]):
        half = halves[level]
        for n in range(positions.shape[0]):
            fx, fy, fz, corners = _corners(positions[n], layout[level], half)
            for f in range(num_features):
                g = features_grad[n, level, f]
                gx = gy = gz = g - g
                if with_jacobian:
                    gx = jacobian_grad[n, level, f, 0] * half
                    gy = jacobian_grad[n, level, f, 1] * half
                    gz = jacobian_grad[n, level, f, 2] * half
                _scatter(table_grad, f, corners, fx, fy, fz, g, gx, gy, gz)


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def grid_backward_outer(positions, table_grad, layout, halves, features_grad, by_feature, directions):
    """`grid_backward` where the Jacobian's gradient is an outer product, by_feature [points, levels, features] times
    directions [points, 3]."""
    num_features = table_grad.shape[1]
    for level in prange(layout.shape[0]):
        half = halves[level]
        for n in range(positions.shape[0]):
            fx, fy, fz, corners = _corners(positions[n], layout[level], half)
            vx, vy, vz = directions[n, 0] * half, directions[n, 1] * half, directions[n, 2] * half
            for f in range(num_features):
                p = by_feature[n, level, f]
                _scatter(table_grad, f, corners, fx, fy, fz, features_grad[n, level, f], p * vx, p * vy, p * vz)


class KernelInterpolation(torch.autograd.Function):
    """Interpolate on the CPU; differentiable in the table, not in the positions."""

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx: FunctionCtx, table: Tensor, positions: Tensor, layout, with_jacobian: bool
    ) -> tuple[Tensor, Tensor]:
        """Returns features [points, levels * features] and, where asked, the Jacobian [.., 3] (else empty)."""
        positions = positions.detach().to(table.dtype).contiguous()
        columns = len(layout) * table.shape[1]
        features = torch.empty(len(positions), columns, dtype=table.dtype)
        jacobian = torch.empty(len(positions) if with_jacobian else 0, columns, 3, dtype=table.dtype)
        arrays = (positions.numpy(), table.detach().numpy(), layout, half_resolutions(layout, positions.numpy().dtype))
        shape = (len(positions), len(layout), table.shape[1])
        by_level = jacobian.view(len(jacobian), *shape[1:], 3)
        grid_forward(*arrays, features.view(shape).numpy(), by_level.numpy(), with_jacobian)
        ctx.save_for_backward(positions)
        ctx.layout, ctx.table_shape, ctx.with_jacobian = layout, table.shape, with_jacobian  # type: ignore[attr-defined]
        return features, jacobian

    @staticmethod
    def backward(ctx, features_grad: Tensor, jacobian_grad: Tensor):  # type: ignore[no-untyped-def]
        """Gradient of the table."""
        (positions,) = ctx.saved_tensors
        table_grad = torch.zeros(ctx.table_shape, dtype=positions.dtype)
        levels = (len(ctx.layout), ctx.table_shape[1])
        grads = (
            features_grad.contiguous().view(-1, *levels).numpy(),
            jacobian_grad.contiguous().view(-1, *levels, 3).numpy(),
        )
        halves = half_resolutions(ctx.layout, positions.numpy().dtype)
        grid_backward(positions.numpy(), table_grad.numpy(), ctx.layout, halves, *grads, ctx.with_jacobian)
        return table_grad, None, None, None


def kernel_layout(resolutions: list[int], sizes: list[int], offsets: list[int]) -> np.ndarray:
    """The level table in the form the kernels take: int64 [levels, 3]."""
    return np.stack([np.array(column, np.int64) for column in (resolutions, sizes, offsets)], -1)


def half_resolutions(layout: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Half of each level's resolution in the positions' type: numba would promote float32 beside an integer."""
    return np.asarray(layout[:, 0] / 2, dtype)
