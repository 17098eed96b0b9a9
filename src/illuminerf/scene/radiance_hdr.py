"""Reader of Radiance HDR (.hdr, RGBE) pictures, the usual format of downloaded lights besides EXR."""

import re
from pathlib import Path

import numpy as np

from illuminerf.workflow.errors import UserError

_MAX_PIXELS = 2**27
_LONGEST_RUN = 127


def read_hdr(path: Path) -> np.ndarray:
    """Read a Radiance picture in the standard orientation (-Y +X): linear_rgb float32 [height, width, 3].

    Raises:
        UserError: not a Radiance picture, truncated, or in another orientation.
    """
    content = Path(path).read_bytes()
    header = re.match(rb"#\?[^\n]*\n(?:[^\n]*\n)*?\n-Y (\d{1,6}) \+X (\d{1,6})\n", content[:16384])
    if not header:
        raise UserError(
            f"{path} is not a readable HDR file",
            wanted="a Radiance picture with the resolution line '-Y height +X width'",
            fix="export it again, or convert it to EXR",
        )
    height, width = int(header[1]), int(header[2])
    if not 0 < height * width <= _MAX_PIXELS:
        raise UserError(
            f"{path} has an impossible size",
            got=f"{width} x {height}",
            wanted=f"at most {_MAX_PIXELS} pixels",
        )
    body = np.frombuffer(content, np.uint8, offset=header.end())
    try:
        rgbe = _scanlines(body, height, width)
    except (IndexError, ValueError) as error:
        raise UserError(f"{path} is truncated or damaged", got=str(error), fix="download or export it again") from error
    scale = np.ldexp(np.float32(1), rgbe[..., 3:].astype(np.int32) - 136)
    return np.where(rgbe[..., 3:] > 0, (rgbe[..., :3] + np.float32(0.5)) * scale, np.float32(0))


def _scanlines(body: np.ndarray, height: int, width: int) -> np.ndarray:
    """RGBE bytes, uint8 [height, width, 4], of run-length coded or flat scanlines."""
    run_length_coded = 8 <= width < 32768 and len(body) > 4 and (body[:2] == 2).all()
    if not run_length_coded:
        if len(body) < height * width * 4:
            raise ValueError(f"{len(body)} bytes of pixels where {height * width * 4} are needed")
        return body[: height * width * 4].reshape(height, width, 4)
    least = 4 + 4 * 2 * -(-width // _LONGEST_RUN)  # bytes of a scanline of runs alone
    if len(body) < height * least:
        raise ValueError(f"{len(body)} bytes of pixels where at least {height * least} are needed")
    rgbe = np.empty((height, 4, width), np.uint8)
    position = 0
    for row in range(height):
        if tuple(body[position : position + 4]) != (2, 2, width >> 8, width & 255):
            raise ValueError(f"scanline {row} does not start as it must")
        position += 4
        for channel in range(4):
            position = _run_lengths(body, position, rgbe[row, channel])
    return rgbe.transpose(0, 2, 1)


def _run_lengths(body: np.ndarray, position: int, line: np.ndarray) -> int:
    """Decode one channel of one scanline into `line`; returns the position behind it."""
    filled = 0
    while filled < len(line):
        count = int(body[position])
        repeated = count > 128
        count -= 128 if repeated else 0
        values = body[position + 1 : position + 2] if repeated else body[position + 1 : position + 1 + count]
        if count == 0 or filled + count > len(line) or len(values) != (1 if repeated else count):
            raise ValueError("a run of pixels is longer than its line")
        line[filled : filled + count] = values
        filled += count
        position += 1 + len(values)
    return position
