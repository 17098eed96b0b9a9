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

_PRIME_Y = 2654435761
_PRIME_Z = 805459861


@njit(inline="always")
@no_type_check
def _cell(position, resolution, half):
    # constants would promote float32 to float64 (slower, and cells that differ from the twin's), so none appear
    scaled = min(max(position * half + half, half - half), half + half)
    floor = min(np.floor(scaled), half + half)
    corner = int(floor)
    if corner == resolution:
        return corner - 1, half / half
    return corner, scaled - floor


@njit(inline="always")
@no_type_check
def _entry(x, y, z, resolution, size, offset):
    side = resolution + 1
    if side * side * side <= size:
        return offset + x + side * (y + side * z)
    return offset + ((x ^ (y * _PRIME_Y) ^ (z * _PRIME_Z)) & (size - 1))


@njit(parallel=True, cache=True)
@no_type_check
def _forward(positions, table, resolutions, sizes, offsets, halves, features, jacobian, with_jacobian):
    num_features = table.shape[1]
    for n in prange(positions.shape[0]):
        for level in range(len(resolutions)):
            resolution, size, offset, half = resolutions[level], sizes[level], offsets[level], halves[level]
            x, fx = _cell(positions[n, 0], resolution, half)
            y, fy = _cell(positions[n, 1], resolution, half)
            z, fz = _cell(positions[n, 2], resolution, half)
            i000 = _entry(x, y, z, resolution, size, offset)
            i100 = _entry(x + 1, y, z, resolution, size, offset)
            i010 = _entry(x, y + 1, z, resolution, size, offset)
            i110 = _entry(x + 1, y + 1, z, resolution, size, offset)
            i001 = _entry(x, y, z + 1, resolution, size, offset)
            i101 = _entry(x + 1, y, z + 1, resolution, size, offset)
            i011 = _entry(x, y + 1, z + 1, resolution, size, offset)
            i111 = _entry(x + 1, y + 1, z + 1, resolution, size, offset)
            for f in range(num_features):
                d00 = table[i100, f] - table[i000, f]
                d10 = table[i110, f] - table[i010, f]
                d01 = table[i101, f] - table[i001, f]
                d11 = table[i111, f] - table[i011, f]
                c00 = table[i000, f] + d00 * fx
                c10 = table[i010, f] + d10 * fx
                c01 = table[i001, f] + d01 * fx
                c11 = table[i011, f] + d11 * fx
                c0 = c00 + (c10 - c00) * fy
                c1 = c01 + (c11 - c01) * fy
                column = level * num_features + f
                features[n, column] = c0 + (c1 - c0) * fz
                if with_jacobian:
                    d0 = d00 + (d10 - d00) * fy
                    d1 = d01 + (d11 - d01) * fy
                    jacobian[n, column, 0] = (d0 + (d1 - d0) * fz) * half
                    jacobian[n, column, 1] = ((c10 - c00) + ((c11 - c01) - (c10 - c00)) * fz) * half
                    jacobian[n, column, 2] = (c1 - c0) * half


@njit(parallel=True, cache=True)
@no_type_check
def _backward(positions, table_grad, resolutions, sizes, offsets, halves, features_grad, jacobian_grad, with_jacobian):
    num_features = table_grad.shape[1]
    for level in prange(len(resolutions)):
        resolution, size, offset, half = resolutions[level], sizes[level], offsets[level], halves[level]
        for n in range(positions.shape[0]):
            x, fx = _cell(positions[n, 0], resolution, half)
            y, fy = _cell(positions[n, 1], resolution, half)
            z, fz = _cell(positions[n, 2], resolution, half)
            i000 = _entry(x, y, z, resolution, size, offset)
            i100 = _entry(x + 1, y, z, resolution, size, offset)
            i010 = _entry(x, y + 1, z, resolution, size, offset)
            i110 = _entry(x + 1, y + 1, z, resolution, size, offset)
            i001 = _entry(x, y, z + 1, resolution, size, offset)
            i101 = _entry(x + 1, y, z + 1, resolution, size, offset)
            i011 = _entry(x, y + 1, z + 1, resolution, size, offset)
            i111 = _entry(x + 1, y + 1, z + 1, resolution, size, offset)
            for f in range(num_features):
                # the transpose of the forward interpolation, one axis at a time: a_* go to value, d_* to slope
                column = level * num_features + f
                g = features_grad[n, column]
                if with_jacobian:
                    gx = jacobian_grad[n, column, 0] * half
                    gy = jacobian_grad[n, column, 1] * half
                    gz = jacobian_grad[n, column, 2] * half
                else:
                    gx = gy = gz = g - g
                top, top_x, top_y = g * fz + gz, gx * fz, gy * fz
                low, low_x, low_y = g - top, gx - top_x, gy - top_y
                back, back_x = low * fy + low_y, low_x * fy
                front, front_x = low - low * fy - low_y, low_x - back_x
                right = front * fx + front_x
                table_grad[i100, f] += right
                table_grad[i000, f] += front - right
                right = back * fx + back_x
                table_grad[i110, f] += right
                table_grad[i010, f] += back - right
                back, back_x = top * fy + top_y, top_x * fy
                front, front_x = top - top * fy - top_y, top_x - back_x
                right = front * fx + front_x
                table_grad[i101, f] += right
                table_grad[i001, f] += front - right
                right = back * fx + back_x
                table_grad[i111, f] += right
                table_grad[i011, f] += back - right


class KernelInterpolation(torch.autograd.Function):
    """Interpolate on the CPU; differentiable in the table, not in the positions."""

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx: FunctionCtx, table: Tensor, positions: Tensor, layout, with_jacobian: bool
    ) -> tuple[Tensor, Tensor]:
        """Returns features [points, levels * features] and, where asked, the Jacobian [.., 3] (else empty)."""
        positions = positions.detach().to(table.dtype).contiguous()
        columns = len(layout[0]) * table.shape[1]
        features = torch.empty(len(positions), columns, dtype=table.dtype)
        jacobian = torch.empty(len(positions) if with_jacobian else 0, columns, 3, dtype=table.dtype)
        arrays = (features.numpy(), jacobian.numpy())
        halves = np.asarray(layout[0] / 2, positions.numpy().dtype)
        _forward(positions.numpy(), table.detach().numpy(), *layout, halves, *arrays, with_jacobian)
        ctx.save_for_backward(positions)
        ctx.layout, ctx.table_shape, ctx.with_jacobian = layout, table.shape, with_jacobian  # type: ignore[attr-defined]
        return features, jacobian

    @staticmethod
    def backward(ctx, features_grad: Tensor, jacobian_grad: Tensor):  # type: ignore[no-untyped-def]
        """Gradient of the table."""
        (positions,) = ctx.saved_tensors
        table_grad = torch.zeros(ctx.table_shape, dtype=positions.dtype)
        grads = (features_grad.contiguous().numpy(), jacobian_grad.contiguous().numpy())
        halves = np.asarray(ctx.layout[0] / 2, positions.numpy().dtype)
        _backward(positions.numpy(), table_grad.numpy(), *ctx.layout, halves, *grads, ctx.with_jacobian)
        return table_grad, None, None, None


def kernel_layout(resolutions: list[int], sizes: list[int], offsets: list[int]) -> tuple[np.ndarray, ...]:
    """The level table in the form the kernels take."""
    return np.array(resolutions, np.int64), np.array(sizes, np.int64), np.array(offsets, np.int64)
