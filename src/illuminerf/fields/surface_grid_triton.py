"""What the surface asks of its hash grid on a GPU, in Triton: features, and sums over the Jacobian without writing it.

Kernels of `surface_triton`, which has the letters and the bytes. A program takes a block of points at one level, one
per thread, as in `hash_grid_triton`. Arrays of features are [levels, points, features].
"""

from typing import no_type_check

import triton
import triton.language as tl

from illuminerf.fields.hash_grid_triton import corner_weights, entries, own_points


@triton.jit
@no_type_check
def _direction(vectors, row, exists, half):
    start = vectors + row * 3
    x = tl.load(start, mask=exists, other=0.0) * half
    y = tl.load(start + 1, mask=exists, other=0.0) * half
    return x, y, tl.load(start + 2, mask=exists, other=0.0) * half


@triton.jit
@no_type_check
def _slope_along(corner: tl.constexpr, wx, wy, wz, gx, gy, gz):
    along = wy * wz * gx if corner & 1 else -(wy * wz * gx)
    along += wx * wz * gy if corner & 2 else -(wx * wz * gy)
    along += wx * wy * gz if corner & 4 else -(wx * wy * gz)
    return along


@triton.jit(do_not_specialize=["num_points"])
@no_type_check
def gather(
    positions,
    table,
    levels,
    directions,
    features,
    num_points,
    num_features: tl.constexpr,
    padded: tl.constexpr,
    is_slope: tl.constexpr,
    block: tl.constexpr,
):
    level, row, exists, half, cell, fx, fy, fz = own_points(positions, table, levels, num_points, block)
    if is_slope:
        gx, gy, gz = _direction(directions, row, exists, half)
    feature = tl.arange(0, padded)[None, :]
    kept = exists[:, None] & (feature < num_features)
    value = tl.zeros((block, padded), table.dtype.element_ty)
    for corner in tl.static_range(8):
        wx, wy, wz = corner_weights(corner, fx, fy, fz)
        entry = entries(corner, *cell)
        stored = tl.load(table + entry[:, None] * num_features + feature, mask=kept, other=0.0)
        if is_slope:
            value += _slope_along(corner, wx, wy, wz, gx, gy, gz)[:, None] * stored
        else:
            value += (wx * wy * wz)[:, None] * stored
    place = level.to(tl.int64) * num_points + row
    tl.store(features + place[:, None] * num_features + feature, value, mask=kept)


@triton.jit(do_not_specialize=["num_points"])
@no_type_check
def slopes(
    positions,
    table,
    levels,
    by_feature,
    gradients,
    num_points,
    num_features: tl.constexpr,
    padded: tl.constexpr,
    block: tl.constexpr,
):
    level, row, exists, half, cell, fx, fy, fz = own_points(positions, table, levels, num_points, block)
    feature = tl.arange(0, padded)[None, :]
    kept = exists[:, None] & (feature < num_features)
    first = level.to(tl.int64) * num_points
    weight = tl.load(by_feature + (first + row)[:, None] * num_features + feature, mask=kept, other=0.0)
    slope_x = tl.zeros((block,), table.dtype.element_ty)
    slope_y, slope_z = slope_x, slope_x
    for corner in tl.static_range(8):
        wx, wy, wz = corner_weights(corner, fx, fy, fz)
        entry = entries(corner, *cell)
        stored = tl.load(table + entry[:, None] * num_features + feature, mask=kept, other=0.0)
        share = tl.sum(weight * stored, axis=1) * half
        slope_x += wy * wz * share if corner & 1 else -(wy * wz * share)
        slope_y += wx * wz * share if corner & 2 else -(wx * wz * share)
        slope_z += wx * wy * share if corner & 4 else -(wx * wy * share)
    start = gradients + first * 3 + row
    tl.store(start, slope_x, mask=exists)
    tl.store(start + num_points, slope_y, mask=exists)
    tl.store(start + num_points.to(tl.int64) * 2, slope_z, mask=exists)


@triton.jit(do_not_specialize=["num_points"])
@no_type_check
def scatter(
    positions,
    table_grad,
    levels,
    features_grad,
    by_feature,
    directions,
    num_points,
    num_features: tl.constexpr,
    padded: tl.constexpr,
    block: tl.constexpr,
):
    level, row, exists, half, cell, fx, fy, fz = own_points(positions, table_grad, levels, num_points, block)
    gx, gy, gz = _direction(directions, row, exists, half)
    feature = tl.arange(0, padded)[None, :]
    kept = exists[:, None] & (feature < num_features)
    place = (level.to(tl.int64) * num_points + row)[:, None] * num_features + feature
    to_value = tl.load(features_grad + place, mask=kept, other=0.0)
    to_slope = tl.load(by_feature + place, mask=kept, other=0.0)
    for corner in tl.static_range(8):
        wx, wy, wz = corner_weights(corner, fx, fy, fz)
        entry = entries(corner, *cell)
        share = (wx * wy * wz)[:, None] * to_value
        share += _slope_along(corner, wx, wy, wz, gx, gy, gz)[:, None] * to_slope
        tl.atomic_add(table_grad + entry[:, None] * num_features + feature, share, mask=kept, sem="relaxed")
