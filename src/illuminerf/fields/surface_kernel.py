"""Signed distance and its gradient on a CPU, in numba: hash grid, hidden layer and both derivatives in one operation.

The fast twin of `SurfaceField.residual`. What it saves over separate ones is traffic of memory: everything lies with
the points last, as the hash grid's kernels leave it; the layers take blocks of points whose numbers stay in the cache;
and the gradient that would reach the Jacobian, of the same size, is never formed, since it is an outer product
(eikonal and normal losses see only `by_feature @ J`).

Letters: h hidden units, f features, i axes; W [h, f] first layer, w [h] last layer, s slope of the softplus,
    distance   = w . softplus(W x + b) + bias            gradient_i = sum_f p_f J_fi,   p_f = sum_h W_hf s_h w_h
and with incoming g (distance) and v_i (gradient), q_f = sum_i J_fi v_i, r_h = sum_f W_hf q_f:
    d/d pre_h = w_h (s_h g + s'_h r_h),  d/d W_hf = x_f d/d pre_h + q_f s_h w_h,  d/d x_f = sum_h W_hf d/d pre_h,
    d/d J_fi  = p_f v_i.
Points are split into a fixed number of parts whose sums are added in order: the result does not depend on threads.
"""

from typing import no_type_check

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import FunctionCtx

from illuminerf.fields.hash_grid_kernel import FAST, grid_backward, grid_forward, kernel_levels

_NUM_PARTS = 16
_BLOCK = 128
_MULTIPLE = 4  # that widths are filled up to with zeros: products go by two rows and four columns

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


@njit(cache=True, fastmath=FAST)
@no_type_check
def _product(weight, x, out):
    """out [rows, block] = weight [rows, columns] @ x [columns, block]."""
    for r in range(0, weight.shape[0], 2):
        for n in range(_BLOCK):
            out[r, n] = out[r + 1, n] = _ZERO
        for c in range(0, weight.shape[1], 4):
            a0, a1, a2, a3 = weight[r, c], weight[r, c + 1], weight[r, c + 2], weight[r, c + 3]
            b0, b1, b2, b3 = weight[r + 1, c], weight[r + 1, c + 1], weight[r + 1, c + 2], weight[r + 1, c + 3]
            for n in range(_BLOCK):
                x0, x1, x2, x3 = x[c, n], x[c + 1, n], x[c + 2, n], x[c + 3, n]
                out[r, n] += a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3
                out[r + 1, n] += b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3


@njit(cache=True, fastmath=FAST)
@no_type_check
def _add_outer(x, y, out):
    """out [rows, columns] += x [rows, block] @ y [columns, block]^T."""
    for r in range(0, out.shape[0], 2):
        for c in range(0, out.shape[1], 4):
            a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = _ZERO
            for n in range(_BLOCK):
                a, b = x[r, n], x[r + 1, n]
                y0, y1, y2, y3 = y[c, n], y[c + 1, n], y[c + 2, n], y[c + 3, n]
                a0, a1, a2, a3 = a0 + a * y0, a1 + a * y1, a2 + a * y2, a3 + a * y3
                b0, b1, b2, b3 = b0 + b * y0, b1 + b * y1, b2 + b * y2, b3 + b * y3
            out[r, c] += a0
            out[r, c + 1] += a1
            out[r, c + 2] += a2
            out[r, c + 3] += a3
            out[r + 1, c] += b0
            out[r + 1, c + 1] += b1
            out[r + 1, c + 2] += b2
            out[r + 1, c + 3] += b3


@njit(cache=True, fastmath=FAST)
@no_type_check
def _fill(source, out):
    """Copy a row [points] into one of a block, whose rest is zero."""
    for n in range(len(source)):
        out[n] = source[n]
    for n in range(len(source), len(out)):
        out[n] = _ZERO


@njit(cache=True, fastmath=FAST)
@no_type_check
def _add_scaled(x, factor, out):
    for n in range(len(out)):
        out[n] += x[n] * factor


@njit(cache=True, fastmath=FAST)
@no_type_check
def _add_multiplied(x, y, out):
    for n in range(len(y)):
        out[n] += x[n] * y[n]


@njit(cache=True, fastmath=FAST)
@no_type_check
def _chain(hidden, slope, of_distance, last, pre, scaled):
    """What comes back through one hidden unit: `pre` holds r and becomes the gradient before the softplus, `scaled`
    becomes s w; returns the gradients of the last layer's weight and of the bias."""
    of_last = of_bias = _ZERO
    for n in range(len(pre)):
        s, r, g = slope[n], pre[n], of_distance[n]
        of_last += g * hidden[n] + s * r
        scaled[n] = s * last
        pre[n] = last * (s * g + _SHARPNESS * s * (_ONE - s) * r)
        of_bias += pre[n]
    return of_last, of_bias


@njit(cache=True, fastmath=FAST, error_model="numpy")  # Python's would ask of every divisor whether it is zero
@no_type_check
def _activate(bias, hidden, slope):
    for k in range(hidden.shape[0]):
        for n in range(_BLOCK):
            hidden[k, n], slope[k, n] = softplus_with_slope(hidden[k, n] + bias[k])


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def _forward_layers(features, jacobian, first, weighted, bias, last, hidden, slope, by_feature, distance, gradient):
    """All with the points last but `gradient` [points, 3]; `weighted` is W^T w. Without a Jacobian only the distance is
    computed."""
    (num_columns, num_points), (num_hidden, width) = features.shape, first.shape
    with_gradient = jacobian.size > 0
    for part in prange(_NUM_PARTS):
        x, p = np.zeros((width, _BLOCK), np.float32), np.empty((width, _BLOCK), np.float32)
        h, s = np.empty((num_hidden, _BLOCK), np.float32), np.empty((num_hidden, _BLOCK), np.float32)
        total = np.empty((4, _BLOCK), np.float32)
        stop = (part + 1) * num_points // _NUM_PARTS
        for start in range(part * num_points // _NUM_PARTS, stop, _BLOCK):
            end = min(start + _BLOCK, stop)
            for c in range(num_columns):
                _fill(features[c, start:end], x[c])
            _product(first, x, h)
            _activate(bias, h, s)
            total[:] = _ZERO
            for k in range(num_hidden):
                _add_scaled(h[k], last[k], total[0])
            distance[start:end] = total[0, : end - start]
            if not with_gradient:
                continue
            for k in range(num_hidden):
                hidden[k, start:end], slope[k, start:end] = h[k, : end - start], s[k, : end - start]
            _product(weighted, s, p)
            for c in range(num_columns):
                by_feature[c, start:end] = p[c, : end - start]
                for axis in range(3):
                    _add_multiplied(p[c], jacobian[c, axis, start:end], total[axis + 1])
            gradient[start:end] = total[1:, : end - start].T


@njit(parallel=True, cache=True, fastmath=FAST)
@no_type_check
def _backward_layers(
    features, jacobian, hidden, slope, first, transposed, last, distance_grad, gradient_grad,
    features_grad, first_grads, bias_grads, last_grads,
):  # fmt: skip
    """With the points last, `gradient_grad` [3, points] too; sums of every part by themselves."""
    (num_columns, num_points), (num_hidden, width) = features.shape, first.shape
    for part in prange(_NUM_PARTS):
        x, q = np.zeros((width, _BLOCK), np.float32), np.zeros((width, _BLOCK), np.float32)
        pre, scaled = np.empty((num_hidden, _BLOCK), np.float32), np.empty((num_hidden, _BLOCK), np.float32)
        g, h, s = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
        stop = (part + 1) * num_points // _NUM_PARTS
        for start in range(part * num_points // _NUM_PARTS, stop, _BLOCK):
            end = min(start + _BLOCK, stop)
            for c in range(num_columns):
                _fill(features[c, start:end], x[c])
                q[c] = _ZERO
                for axis in range(3):
                    _add_multiplied(gradient_grad[axis, start:end], jacobian[c, axis, start:end], q[c])
            _product(first, q, pre)
            _fill(distance_grad[start:end], g)
            for k in range(num_hidden):
                _fill(hidden[k, start:end], h)
                _fill(slope[k, start:end], s)
                of_last, of_bias = _chain(h, s, g, last[k], pre[k], scaled[k])
                last_grads[part, k] += of_last
                bias_grads[part, k] += of_bias
            _add_outer(pre, x, first_grads[part])
            _add_outer(scaled, q, first_grads[part])
            _product(transposed, pre, x)
            for c in range(num_columns):
                features_grad[c, start:end] = x[c, : end - start]


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
        places, levels = _places(positions), _levels(layout, level_weights)
        num_columns, num_points = len(layout) * table.shape[1], places.shape[1]
        features, by_feature = (np.empty((num_columns, num_points), np.float32) for _ in range(2))
        jacobian = np.empty((num_columns, 3, num_points), np.float32)
        grid_forward(places, table.detach().numpy(), *levels, features, jacobian, True)
        layers = _layers(weight, bias, last)
        hidden, slope = (np.empty((len(layers[0]), num_points), np.float32) for _ in range(2))
        distance, gradient = np.empty(num_points, np.float32), np.empty((num_points, 3), np.float32)
        _forward_layers(features, jacobian, *layers, hidden, slope, by_feature, distance, gradient)
        ctx.arrays = (features, jacobian, hidden, slope, layers[0], layers[3])  # type: ignore[attr-defined]
        ctx.grid = (places, table.shape, levels, by_feature)  # type: ignore[attr-defined]
        ctx.shape = weight.shape  # type: ignore[attr-defined]
        return torch.from_numpy(distance), torch.from_numpy(gradient)

    @staticmethod
    def backward(ctx, distance_grad: Tensor, gradient_grad: Tensor):  # type: ignore[no-untyped-def]
        """Gradients of table, weight, bias and last layer."""
        places, table_shape, levels, by_feature = ctx.grid
        num_hidden, width = ctx.shape
        incoming = (distance_grad.contiguous().numpy(), gradient_grad.T.contiguous().numpy())
        features_grad, first = np.empty_like(by_feature), ctx.arrays[4]
        sums = [np.zeros((_NUM_PARTS, *shape), np.float32) for shape in (first.shape, first.shape[:1], first.shape[:1])]
        *arrays, last = ctx.arrays
        _backward_layers(*arrays, np.ascontiguousarray(first.T), last, *incoming, features_grad, *sums)
        table_grad = torch.zeros(table_shape)
        no_jacobian = np.empty((0, 3, 0), np.float32)
        grid_backward(places, table_grad.numpy(), *levels, features_grad, no_jacobian, by_feature, incoming[1])
        first_grad, bias_grad, last_grad = (torch.from_numpy(part.sum(0)) for part in sums)
        of_layers = (first_grad[:num_hidden, :width], bias_grad[:num_hidden], last_grad[None, :num_hidden])
        return table_grad, *of_layers, None, None, None


def distance_alone(
    table: Tensor, weight: Tensor, bias: Tensor, last: Tensor, positions: Tensor, layout: np.ndarray,
    level_weights: Tensor,
) -> Tensor:  # fmt: skip
    """The distance of `FusedSurface`, for those who need no derivative of any kind."""
    places = _places(positions)
    features = np.empty((len(layout) * table.shape[1], places.shape[1]), np.float32)
    no_matrix, no_jacobian = np.empty((0, 0), np.float32), np.empty((0, 3, 0), np.float32)
    grid_forward(places, table.detach().numpy(), *_levels(layout, level_weights), features, no_jacobian, False)
    distance = np.empty(places.shape[1], np.float32)
    unused = (no_matrix, no_matrix, no_matrix, distance, no_matrix)
    _forward_layers(features, no_jacobian, *_layers(weight, bias, last), *unused)
    return torch.from_numpy(distance)


def _places(positions: Tensor) -> np.ndarray:
    return positions.detach().T.contiguous().numpy()


def _levels(layout: np.ndarray, level_weights: Tensor) -> tuple[np.ndarray, ...]:
    return kernel_levels(layout, np.dtype(np.float32), level_weights.detach().numpy())


def _layers(weight: Tensor, bias: Tensor, last: Tensor) -> tuple[np.ndarray, ...]:
    """First layer, its transpose times the last layer, its bias and the last layer, filled up with zeros."""
    num_hidden, width = (-size % _MULTIPLE for size in weight.shape)
    first = np.pad(weight.detach().numpy(), ((0, num_hidden), (0, width)))
    biases, lasts = (np.pad(row.detach().numpy().ravel(), (0, num_hidden)) for row in (bias, last))
    return first, np.ascontiguousarray(first.T * lasts), biases, lasts
