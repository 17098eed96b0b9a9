"""Signed distance and its gradient on a CPU, in numba: hash grid, hidden layer and both derivatives in one operation.

The fast twin of `SurfaceField.residual`. What it saves over separate ones is traffic of memory: the hash grid writes
its Jacobian level by level in one stretch each, and the gradient that would reach it, of the same size, is never
formed, since it is an outer product (eikonal and normal losses see only `by_feature @ J`).

Letters: h hidden units, f features, i axes; W [f, h] first layer, w [h] last layer, s slope of the softplus,
    distance   = w . softplus(W^T x + b) + bias          gradient_i = sum_f p_f J_fi,   p_f = sum_h W_fh s_h w_h
and with incoming g (distance) and v_i (gradient), q_f = sum_i J_fi v_i, r_h = sum_f W_fh q_f:
    d/d pre_h = w_h (s_h g + s'_h r_h),  d/d W_fh = x_f d/d pre_h + q_f s_h w_h,  d/d x_f = sum_h W_fh d/d pre_h,
    d/d J_fi  = p_f v_i.
Points are split into a fixed number of parts whose sums are added in order: the result does not depend on threads.
"""

from typing import no_type_check

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import FunctionCtx

from illuminerf.fields.hash_grid_kernel import FAST, grid_backward_outer, grid_forward, half_resolutions

_NUM_PARTS = 16

_SHARPNESS = np.float32(100.0)
_ZERO, _ONE, _TWO, _LARGEST = np.float32(0), np.float32(1), np.float32(2), np.float32(24)
_LOG2_E, _LOG_2 = np.float32(np.log2(np.e)), np.float32(np.log(2))
_E2, _E3, _E4 = np.float32(1 / 2), np.float32(1 / 6), np.float32(1 / 24)
_E5, _E6, _E7 = np.float32(1 / 120), np.float32(1 / 720), np.float32(1 / 5040)
_L3, _L5, _L7 = np.float32(1 / 3), np.float32(1 / 5), np.float32(1 / 7)
_L9, _L11, _L13 = np.float32(1 / 9), np.float32(1 / 11), np.float32(1 / 13)


@njit(inline="always", fastmath=FAST)
@no_type_check
def softplus_with_slope(value):
    """Softplus of sharpness 100 and its slope; polynomials in place of exp and log, which would not vectorise."""
    exponent = min(abs(value) * _SHARPNESS, _LARGEST) * _LOG2_E
    whole = np.int32(exponent)
    t = (np.float32(whole) - exponent) * _LOG_2
    tail = _ONE + t * (_ONE + t * (_E2 + t * (_E3 + t * (_E4 + t * (_E5 + t * (_E6 + t * _E7))))))
    tail = tail / np.float32(np.int32(1) << whole)
    z = tail / (_TWO + tail)
    y = z * z
    log1p = _TWO * z * (_ONE + y * (_L3 + y * (_L5 + y * (_L7 + y * (_L9 + y * (_L11 + y * _L13))))))
    slope = _ONE / (_ONE + tail)
    if value <= _ZERO:
        slope = tail * slope
    return max(value, _ZERO) + log1p / _SHARPNESS, slope


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def _forward_layers(features, jacobian, first, bias, last, by_feature, hidden, slope, distance, gradient):
    num_levels, num_features, num_hidden = first.shape
    for n in prange(features.shape[0]):
        h, s = hidden[n], slope[n]
        for k in range(num_hidden):
            h[k] = bias[k]
        for level in range(num_levels):
            for f in range(num_features):
                value = features[n, level, f]
                for k in range(num_hidden):
                    h[k] += value * first[level, f, k]
        total = _ZERO
        for k in range(num_hidden):
            h[k], s[k] = softplus_with_slope(h[k])
            total += h[k] * last[k]
        gx = gy = gz = _ZERO
        for level in range(num_levels):
            for f in range(num_features):
                value = _ZERO
                for k in range(num_hidden):
                    value += first[level, f, k] * (s[k] * last[k])
                by_feature[n, level, f] = value
                gx += value * jacobian[n, level, f, 0]
                gy += value * jacobian[n, level, f, 1]
                gz += value * jacobian[n, level, f, 2]
        distance[n] = total
        gradient[n, 0], gradient[n, 1], gradient[n, 2] = gx, gy, gz


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def _distance_layers(features, first, bias, last, distance):
    num_levels, num_features, num_hidden = first.shape
    num_parts = _NUM_PARTS
    for part in prange(num_parts):
        h = np.empty(num_hidden, np.float32)
        for n in range(part * len(distance) // num_parts, (part + 1) * len(distance) // num_parts):
            for k in range(num_hidden):
                h[k] = bias[k]
            for level in range(num_levels):
                for f in range(num_features):
                    value = features[n, level, f]
                    for k in range(num_hidden):
                        h[k] += value * first[level, f, k]
            total = _ZERO
            for k in range(num_hidden):
                softplus, _ = softplus_with_slope(h[k])
                total += softplus * last[k]
            distance[n] = total


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def _backward_layers(
    features, jacobian, hidden, slope, first, last, distance_grad, gradient_grad,
    features_grad, first_grads, bias_grads, last_grads,
):  # fmt: skip
    num_points, (num_levels, num_features, num_hidden) = features.shape[0], first.shape
    num_parts = first_grads.shape[0]
    for part in prange(num_parts):
        first_grad, bias_grad, last_grad = first_grads[part], bias_grads[part], last_grads[part]
        pre = np.empty(num_hidden, np.float32)
        scaled = np.empty(num_hidden, np.float32)
        q = np.empty((num_levels, num_features), np.float32)
        for n in range(part * num_points // num_parts, (part + 1) * num_points // num_parts):
            g, vx, vy, vz = distance_grad[n], gradient_grad[n, 0], gradient_grad[n, 1], gradient_grad[n, 2]
            h, s = hidden[n], slope[n]
            for k in range(num_hidden):
                pre[k] = _ZERO
            for level in range(num_levels):
                for f in range(num_features):
                    jx, jy, jz = jacobian[n, level, f, 0], jacobian[n, level, f, 1], jacobian[n, level, f, 2]
                    q[level, f] = jx * vx + jy * vy + jz * vz
                    for k in range(num_hidden):
                        pre[k] += q[level, f] * first[level, f, k]
            for k in range(num_hidden):
                r = pre[k]
                last_grad[k] += g * h[k] + s[k] * r
                scaled[k] = s[k] * last[k]
                pre[k] = last[k] * (s[k] * g + _SHARPNESS * s[k] * (_ONE - s[k]) * r)
                bias_grad[k] += pre[k]
            for level in range(num_levels):
                for f in range(num_features):
                    total, value, slopes = _ZERO, features[n, level, f], q[level, f]
                    for k in range(num_hidden):
                        total += first[level, f, k] * pre[k]
                        first_grad[level, f, k] += value * pre[k] + slopes * scaled[k]
                    features_grad[n, level, f] = total


class FusedSurface(torch.autograd.Function):
    """Distance [points] without its bias, and gradient [points, 3]; float32 on the CPU.

    Differentiable in the table and both layers, not in the positions.
    """

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx: FunctionCtx, table: Tensor, weight: Tensor, bias: Tensor, last: Tensor, positions: Tensor, layout,
        level_weights: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """`weight` [hidden, width] and `last` [1, hidden] as torch's linear layers hold them."""
        positions = positions.detach().contiguous()
        num_points, num_hidden, num_features = len(positions), len(weight), table.shape[1]
        levels = (layout, half_resolutions(layout, np.dtype(np.float32)))
        features, jacobian, by_feature = (
            _levels_outermost(len(layout), num_points, num_features, *rest) for rest in ((), (3,), ())
        )
        grid_forward(positions.numpy(), table.detach().numpy(), *levels, features, jacobian, True)
        scales = level_weights.detach().numpy().astype(np.float32)[:, None]
        features *= scales
        jacobian *= scales[..., None]
        hidden, slope, distance, gradient = (
            np.empty((num_points, *shape), np.float32) for shape in ((num_hidden,), (num_hidden,), (), (3,))
        )
        first = np.ascontiguousarray(weight.detach().numpy().T).reshape(len(layout), num_features, num_hidden)
        layers = (first, bias.detach().numpy(), last.detach().numpy()[0])
        _forward_layers(features, jacobian, *layers, by_feature, hidden, slope, distance, gradient)
        ctx.arrays = (features, jacobian, hidden, slope, first, layers[2].copy())  # type: ignore[attr-defined]
        ctx.grid = (positions.numpy(), table.shape, levels, scales, by_feature)  # type: ignore[attr-defined]
        return torch.from_numpy(distance), torch.from_numpy(gradient)

    @staticmethod
    def backward(ctx, distance_grad: Tensor, gradient_grad: Tensor):  # type: ignore[no-untyped-def]
        """Gradients of table, weight, bias and last layer."""
        first = ctx.arrays[4]
        positions, table_shape, levels, scales, by_feature = ctx.grid
        incoming = (distance_grad.contiguous().numpy(), gradient_grad.contiguous().numpy())
        num_hidden = first.shape[-1]
        features_grad = _levels_outermost(len(first), len(positions), first.shape[1])
        sums = [np.zeros((_NUM_PARTS, *shape), np.float32) for shape in (first.shape, (num_hidden,), (num_hidden,))]
        _backward_layers(*ctx.arrays, *incoming, features_grad, *sums)
        table_grad = torch.zeros(table_shape)
        features_grad *= scales
        grid_backward_outer(positions, table_grad.numpy(), *levels, features_grad, by_feature * scales, incoming[1])
        first_grad, bias_grad, last_grad = (torch.from_numpy(part.sum(0)) for part in sums)
        weight_grad = first_grad.view(-1, num_hidden).T.contiguous()
        return table_grad, weight_grad, bias_grad, last_grad[None], None, None, None


def distance_alone(
    table: Tensor, weight: Tensor, bias: Tensor, last: Tensor, positions: Tensor, layout: np.ndarray,
    level_weights: Tensor,
) -> Tensor:  # fmt: skip
    """The distance of `FusedSurface`, for those who need no derivative of any kind."""
    num_features, halves = table.shape[1], half_resolutions(layout, np.dtype(np.float32))
    features = _levels_outermost(len(layout), len(positions), num_features)
    places = positions.detach().contiguous().numpy()
    # the Jacobian is not asked for, so that any array of its kind will do
    grid_forward(places, table.detach().numpy(), layout, halves, features, features[..., None], False)
    features *= level_weights.detach().numpy().astype(np.float32)[:, None]
    first = np.ascontiguousarray(weight.detach().numpy().T).reshape(len(layout), num_features, len(weight))
    distance = np.empty(len(positions), np.float32)
    _distance_layers(features, first, bias.detach().numpy(), last.detach().numpy()[0], distance)
    return torch.from_numpy(distance)


def _levels_outermost(num_levels: int, num_points: int, *rest: int) -> np.ndarray:
    """Uninitialised float32 [points, levels, ...] that lies in memory level by level."""
    return np.empty((num_levels, num_points, *rest), np.float32).swapaxes(0, 1)
