"""16-bit colour PNG, which Pillow would silently cut to 8 bits.

The PNG specification (W3C, section 9, "Filtering") predicts every byte from its left, upper and upper-left
neighbours, so a row cannot be decoded at once. Pixels on one anti-diagonal do not depend on each other: the
loop below runs over the width + height anti-diagonals and treats each as one array.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {2: 3, 4: 2, 6: 4}


def _header(path: Path) -> tuple[int, int, int, int, int]:
    """(width, height, bit depth, colour type, interlace method)."""
    with open(path, "rb") as file:
        head = file.read(33)
    if len(head) < 33 or not head.startswith(_SIGNATURE) or head[12:16] != b"IHDR":
        raise ValueError("not a PNG file")
    width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", head[16:29])
    return width, height, depth, colour, interlace


def is_deep_colour_png(path: Path) -> bool:
    """True for 16 bits per channel with more than one channel."""
    _, _, depth, colour, _ = _header(path)
    return depth == 16 and colour in _CHANNELS


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    position = len(_SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack(">I", data[position : position + 4])
        yield data[position + 4 : position + 8], data[position + 8 : position + 8 + length]
        position += 12 + length


def read_deep_png(path: Path) -> np.ndarray:
    """float32 [height, width, 4] in [0, 1] of a PNG for which `is_deep_colour_png` holds.

    Raises ValueError or zlib.error where the file is truncated, corrupt or interlaced.
    """
    width, height, _, colour, interlace = _header(path)
    if interlace:
        raise ValueError("interlaced 16-bit PNG is not supported; save it without interlacing")
    num_channels = _CHANNELS[colour]
    stride = width * num_channels * 2
    expected = height * (stride + 1)
    packed = b"".join(body for kind, body in _chunks(path.read_bytes()) if kind == b"IDAT")
    raw = zlib.decompressobj().decompress(packed, expected)  # never more than the header promises
    if len(raw) < expected:
        raise ValueError("image data ends early")
    rows = np.frombuffer(raw, np.uint8).reshape(height, stride + 1)
    pixels = _unfiltered(rows[:, 0], rows[:, 1:].reshape(height, width, num_channels * 2))
    values = np.ascontiguousarray(pixels).view(">u2").astype(np.float32) / 65535
    colours = values if colour == 2 else values[..., :-1]
    alpha = np.ones((height, width, 1), np.float32) if colour == 2 else values[..., -1:]
    return np.concatenate([np.broadcast_to(colours, (height, width, 3)), alpha], axis=-1)


def _unfiltered(filters: np.ndarray, filtered: np.ndarray) -> np.ndarray:
    """uint8 [height, width, bytes]: the reverse of the filters [height] (0 none, 1 sub, 2 up, 3 average, 4
    Paeth).
    """
    if filters.max(initial=0) > 4:
        raise ValueError("unknown PNG filter")
    height, width, num_bytes = filtered.shape
    # One row above and one pixel to the left of the image count as zero.
    out = np.zeros((height + 1, width + 1, num_bytes), np.int32)
    for diagonal in range(width + height - 1):
        y = np.arange(max(0, diagonal - width + 1), min(height, diagonal + 1))
        x = diagonal - y
        left, up, corner = out[y + 1, x], out[y, x + 1], out[y, x]
        kind = filters[y][:, None]
        estimate = left + up - corner
        to_left, to_up, to_corner = abs(estimate - left), abs(estimate - up), abs(estimate - corner)
        nearest = np.where(to_up <= to_corner, up, corner)
        paeth = np.where((to_left <= to_up) & (to_left <= to_corner), left, nearest)
        predicted = np.select([kind == 1, kind == 2, kind == 3, kind == 4], [left, up, (left + up) // 2, paeth], 0)
        out[y + 1, x + 1] = (filtered[y, x] + predicted) & 255
    return out[1:, 1:].astype(np.uint8)
