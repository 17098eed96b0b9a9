"""Change of size of linear premultiplied images: exact area average, and padding to one common size."""

import numpy as np
from scipy import sparse


def area_weights(num_in: int, num_out: int) -> sparse.csr_array:
    """float32 [num_out, num_in], rows summing to 1: the share of each input pixel in each (larger) output
    pixel.
    """
    edges_in = np.arange(num_in + 1)
    edges_out = np.linspace(0, num_in, num_out + 1)
    first = np.floor(edges_out[:-1]).astype(int)
    reach = int(np.ceil(num_in / num_out)) + 1
    columns = first[:, None] + np.arange(reach)
    inside = columns < num_in
    clipped = np.minimum(columns, num_in - 1)
    low = np.maximum(edges_in[clipped], edges_out[:-1, None])
    high = np.minimum(edges_in[clipped + 1], edges_out[1:, None])
    overlap = np.where(inside, np.maximum(high - low, 0), 0)
    overlap /= overlap.sum(axis=1, keepdims=True)
    rows = np.broadcast_to(np.arange(num_out)[:, None], columns.shape)
    keep = overlap > 0
    return sparse.csr_array(
        (overlap[keep].astype(np.float32), (rows[keep], clipped[keep])), shape=(num_out, num_in), dtype=np.float32
    )


def area_downsampled(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """float32 [height, width, channels]: area average of `image` [>= height, >= width, channels].

    Right for colour only where `image` is linear and premultiplied.
    """
    num_rows, num_columns, num_channels = image.shape
    if (num_rows, num_columns) == (height, width):
        return image
    if height > num_rows or width > num_columns:
        raise ValueError(f"cannot enlarge {num_rows} x {num_columns} to {height} x {width}")
    rows = area_weights(num_rows, height) @ image.reshape(num_rows, -1).astype(np.float32)
    columns = rows.reshape(height, num_columns, num_channels).transpose(1, 0, 2).reshape(num_columns, -1)
    small = area_weights(num_columns, width) @ columns
    return np.ascontiguousarray(small.reshape(width, height, num_channels).transpose(1, 0, 2))


def padding_to(size: tuple[int, int], common: tuple[int, int]) -> tuple[int, int]:
    """(left, top) margin in pixels that centres an image of `size` (width, height) in the `common` size."""
    return (common[0] - size[0]) // 2, (common[1] - size[1]) // 2


def padded(image: np.ndarray, common: tuple[int, int]) -> np.ndarray:
    """`image` [height, width, channels] centred in `common` (width, height), zero (transparent) around it."""
    height, width, num_channels = image.shape
    left, top = padding_to((width, height), common)
    out = np.zeros((common[1], common[0], num_channels), image.dtype)
    out[top : top + height, left : left + width] = image
    return out
