"""The multi-resolution hash grid on a CPU, in numba: the fast twin of `hash_grid.interpolate`.

Everything lies with the points last, and is computed by blocks of points that stay in the first-level cache: where the
points lie, what the table holds there, and what comes of it are loops of their own, so that only reading and writing
the table is not vector arithmetic. These loops see whole arrays, or parts that were cut out before: with
`array[start + n]` in them, rounding depended on where arrays happened to lie (LLVM, it seems, then asks at run time
whether they overlap, and leaves out the vectors).

Forward runs in parallel over levels and parts of the points: a thread stays with one level, whose table stays in its
cache. Backward runs in parallel over levels: levels share no table entries, so no two threads write to the same place,
and every sum has one fixed order.
"""

from typing import no_type_check

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import FunctionCtx

_PRIME_Y, _PRIME_Z = np.uint32(2654435761), np.uint32(805459861)
_NUM_PARTS = 4  # of the points of each level
_BLOCK = 64
FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(inline="always")
@no_type_check
def _cell(position, resolution, half):
    # constants would promote float32 to float64 (slower, and cells that differ from the twin's), so none appear
    scaled = min(max(position * half + half, half - half), half + half)
    corner = max(min(np.int32(scaled), np.int32(resolution - 1)), np.int32(0))
    return np.uint32(corner), scaled - corner * (half / half)


@njit(cache=True, fastmath=FAST)
@no_type_check
def _locate(xs, ys, zs, level, half, inside, corners):
    """Where points lie in their cells of one level, `inside` [3, points], and the table's entries at the cells'
    `corners` [8, points]; x changes fastest from corner to corner.

    Unsigned throughout: numba would ask of every signed index whether it counts from the end.
    """
    resolution, size, offset = level[0], level[1], np.uint32(level[2])
    one, side = np.uint32(1), np.uint32(resolution + 1)
    if (resolution + 1) * (resolution + 1) * (resolution + 1) <= size:
        for n in range(len(xs)):
            x, inside[0, n] = _cell(xs[n], resolution, half)
            y, inside[1, n] = _cell(ys[n], resolution, half)
            z, inside[2, n] = _cell(zs[n], resolution, half)
            low = offset + x + side * (y + side * z)
            high = low + side * side
            corners[0, n], corners[1, n] = low, low + one
            corners[2, n], corners[3, n] = low + side, low + side + one
            corners[4, n], corners[5, n] = high, high + one
            corners[6, n], corners[7, n] = high + side, high + side + one
        return
    mask = np.uint32(size - 1)
    for n in range(len(xs)):
        x, inside[0, n] = _cell(xs[n], resolution, half)
        y, inside[1, n] = _cell(ys[n], resolution, half)
        z, inside[2, n] = _cell(zs[n], resolution, half)
        x1, y0, z0 = x + one, y * _PRIME_Y, z * _PRIME_Z
        y1, z1 = y0 + _PRIME_Y, z0 + _PRIME_Z
        h00, h10, h01, h11 = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        corners[0, n], corners[1, n] = offset + ((x ^ h00) & mask), offset + ((x1 ^ h00) & mask)
        corners[2, n], corners[3, n] = offset + ((x ^ h10) & mask), offset + ((x1 ^ h10) & mask)
        corners[4, n], corners[5, n] = offset + ((x ^ h01) & mask), offset + ((x1 ^ h01) & mask)
        corners[6, n], corners[7, n] = offset + ((x ^ h11) & mask), offset + ((x1 ^ h11) & mask)


@njit(cache=True, fastmath=FAST)
@no_type_check
def _look_up(table, corners, count, values):
    """What a table holds at corners [8, points]: values [features, 8, points], two features at a time."""
    num_features = table.shape[1]
    for f in range(0, num_features - 1, 2):
        for c in range(8):
            for n in range(count):
                values[f, c, n], values[f + 1, c, n] = table[corners[c, n], f], table[corners[c, n], f + 1]
    if num_features % 2:
        for c in range(8):
            for n in range(count):
                values[num_features - 1, c, n] = table[corners[c, n], num_features - 1]


@njit(cache=True, fastmath=FAST)
@no_type_check
def _add_to(table, corners, count, values):
    """The transpose of `_look_up`: add values to a table."""
    num_features = table.shape[1]
    for f in range(0, num_features - 1, 2):
        for c in range(8):
            for n in range(count):
                table[corners[c, n], f] += values[f, c, n]
                table[corners[c, n], f + 1] += values[f + 1, c, n]
    if num_features % 2:
        for c in range(8):
            for n in range(count):
                table[corners[c, n], num_features - 1] += values[num_features - 1, c, n]


@njit(cache=True, fastmath=FAST)
@no_type_check
def _interpolate(values, inside, weight, feature):
    """One feature [points], times a weight, from its values at the corners [8, points]."""
    for n in range(feature.shape[0]):
        fx, fy, fz = inside[0, n], inside[1, n], inside[2, n]
        c00, c10 = values[0, n] + (values[1, n] - values[0, n]) * fx, values[2, n] + (values[3, n] - values[2, n]) * fx
        c01, c11 = values[4, n] + (values[5, n] - values[4, n]) * fx, values[6, n] + (values[7, n] - values[6, n]) * fx
        c0, c1 = c00 + (c10 - c00) * fy, c01 + (c11 - c01) * fy
        feature[n] = (c0 + (c1 - c0) * fz) * weight


@njit(cache=True, fastmath=FAST)
@no_type_check
def _interpolate_slopes(values, inside, scale, x_slope, y_slope, z_slope):
    """The derivatives of one feature, times a scale."""
    for n in range(x_slope.shape[0]):
        fx, fy, fz = inside[0, n], inside[1, n], inside[2, n]
        d00, d10 = values[1, n] - values[0, n], values[3, n] - values[2, n]
        d01, d11 = values[5, n] - values[4, n], values[7, n] - values[6, n]
        c00, c10 = values[0, n] + d00 * fx, values[2, n] + d10 * fx
        c01, c11 = values[4, n] + d01 * fx, values[6, n] + d11 * fx
        c0, c1 = c00 + (c10 - c00) * fy, c01 + (c11 - c01) * fy
        d0, d1 = d00 + (d10 - d00) * fy, d01 + (d11 - d01) * fy
        x_slope[n] = (d0 + (d1 - d0) * fz) * scale
        y_slope[n] = ((c10 - c00) + ((c11 - c01) - (c10 - c00)) * fz) * scale
        z_slope[n] = (c1 - c0) * scale


@njit(cache=True, fastmath=FAST)
@no_type_check
def _spread(grads, inside, count, values):
    """The transpose of interpolation, one axis at a time: what the corners [8, points] get of the gradients of one
    feature and of its three slopes, `grads` [4, points]."""
    for n in range(count):
        fx, fy, fz = inside[0, n], inside[1, n], inside[2, n]
        g, gx, gy, gz = grads[0, n], grads[1, n], grads[2, n], grads[3, n]
        top, top_x, top_y = g * fz + gz, gx * fz, gy * fz
        low, low_x, low_y = g - top, gx - top_x, gy - top_y
        back, back_x = low * fy + low_y, low_x * fy
        front, front_x = low - back, low_x - back_x
        right = front * fx + front_x
        values[0, n], values[1, n] = front - right, right
        right = back * fx + back_x
        values[2, n], values[3, n] = back - right, right
        back, back_x = top * fy + top_y, top_x * fy
        front, front_x = top - back, top_x - back_x
        right = front * fx + front_x
        values[4, n], values[5, n] = front - right, right
        right = back * fx + back_x
        values[6, n], values[7, n] = back - right, right


@njit(cache=True, fastmath=FAST)
@no_type_check
def _scale(source, scale, out):
    for n in range(len(source)):
        out[n] = source[n] * scale


@njit(cache=True, fastmath=FAST)
@no_type_check
def _multiply(out, by):
    for n in range(len(by)):
        out[n] *= by[n]


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def grid_forward(positions, table, layout, halves, weights, features, jacobian, with_jacobian):
    """Features [levels * features, points] and, where asked, the Jacobian [levels * features, 3, points]; each level
    times its weight."""
    num_points, num_features = positions.shape[1], table.shape[1]
    for job in prange(_NUM_PARTS * layout.shape[0]):
        level, part = job // _NUM_PARTS, job % _NUM_PARTS
        inside, corners = np.zeros((3, _BLOCK), positions.dtype), np.empty((8, _BLOCK), np.uint32)
        values = np.zeros((num_features, 8, _BLOCK), positions.dtype)
        stop = (part + 1) * num_points // _NUM_PARTS
        for start in range(part * num_points // _NUM_PARTS, stop, _BLOCK):
            end = min(start + _BLOCK, stop)
            if weights[level] != 0:  # else all values stay zero
                x, y, z = positions[0, start:end], positions[1, start:end], positions[2, start:end]
                _locate(x, y, z, layout[level], halves[level], inside, corners)
                _look_up(table, corners, end - start, values)
            for f in range(num_features):
                column = level * num_features + f
                _interpolate(values[f], inside, weights[level], features[column, start:end])
                if with_jacobian:
                    slopes, scale = jacobian[column], halves[level] * weights[level]
                    x, y, z = slopes[0, start:end], slopes[1, start:end], slopes[2, start:end]
                    _interpolate_slopes(values[f], inside, scale, x, y, z)


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def grid_backward(positions, table_grad, layout, halves, weights, features_grad, jacobian_grad, by_feature, directions):
    """Add to the gradient of the table.

    The Jacobian's gradient is `jacobian_grad` [levels * features, 3, points]; or, where that is empty, the outer
    product of `by_feature` [levels * features, points] and `directions` [3, points]; or, where these are empty, zero.
    """
    num_points, num_features = positions.shape[1], table_grad.shape[1]
    for level in prange(layout.shape[0]):
        inside, corners = np.empty((3, _BLOCK), positions.dtype), np.empty((8, _BLOCK), np.uint32)
        values = np.empty((num_features, 8, _BLOCK), positions.dtype)
        grads = np.zeros((4, _BLOCK), positions.dtype)
        weight, scale = weights[level], halves[level] * weights[level]
        for start in range(0, num_points if weight != 0 else 0, _BLOCK):
            end = min(start + _BLOCK, num_points)
            x, y, z = positions[0, start:end], positions[1, start:end], positions[2, start:end]
            _locate(x, y, z, layout[level], halves[level], inside, corners)
            for f in range(num_features):
                column = level * num_features + f
                _scale(features_grad[column, start:end], weight, grads[0])
                for axis in range(3):
                    if jacobian_grad.size:
                        _scale(jacobian_grad[column, axis, start:end], scale, grads[axis + 1])
                    elif by_feature.size:
                        _scale(by_feature[column, start:end], scale, grads[axis + 1])
                        _multiply(grads[axis + 1], directions[axis, start:end])
                _spread(grads, inside, end - start, values[f])
            _add_to(table_grad, corners, end - start, values)


class KernelInterpolation(torch.autograd.Function):
    """Interpolate on the CPU; differentiable in the table, not in the positions."""

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx: FunctionCtx, table: Tensor, positions: Tensor, layout, with_jacobian: bool
    ) -> tuple[Tensor, Tensor]:
        """Returns features [points, levels * features] and, where asked, the Jacobian [.., 3] (else empty).

        Both lie in memory with the points last.
        """
        places = positions.detach().to(table.dtype).T.contiguous()
        columns, num_points = len(layout) * table.shape[1], places.shape[1]
        features = torch.empty(columns, num_points, dtype=table.dtype)
        jacobian = torch.empty(columns, 3, num_points if with_jacobian else 0, dtype=table.dtype)
        levels = kernel_levels(layout, places.numpy().dtype)
        grid_forward(places.numpy(), table.detach().numpy(), *levels, features.numpy(), jacobian.numpy(), with_jacobian)
        ctx.save_for_backward(places)
        ctx.levels, ctx.table_shape = levels, table.shape  # type: ignore[attr-defined]
        return features.T, jacobian.permute(2, 0, 1)

    @staticmethod
    def backward(ctx, features_grad: Tensor, jacobian_grad: Tensor):  # type: ignore[no-untyped-def]
        """Gradient of the table."""
        (places,) = ctx.saved_tensors
        table_grad = torch.zeros(ctx.table_shape, dtype=places.dtype)
        of_features, of_jacobian = features_grad.T.contiguous().numpy(), jacobian_grad.permute(1, 2, 0).contiguous()
        nothing = np.empty((0, 0), of_features.dtype)
        grid_backward(
            places.numpy(), table_grad.numpy(), *ctx.levels, of_features, of_jacobian.numpy(), nothing, nothing
        )
        return table_grad, None, None, None


def kernel_layout(resolutions: list[int], sizes: list[int], offsets: list[int]) -> np.ndarray:
    """The level table in the form the kernels take: int64 [levels, 3]."""
    return np.stack([np.array(column, np.int64) for column in (resolutions, sizes, offsets)], -1)


def kernel_levels(
    layout: np.ndarray, dtype: np.dtype, weights: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the kernels know of the levels: the layout, half of each resolution, and each level's weight (else one).

    In the positions' type: numba would promote float32 beside an integer.
    """
    known = np.ones(len(layout)) if weights is None else weights
    return layout, np.array(layout[:, 0] / 2, dtype), np.array(known, dtype)
