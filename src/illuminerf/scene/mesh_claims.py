"""What a mesh file claims to hold, before a library allocates memory by its word."""

import json
import re
import struct
from pathlib import Path
from typing import Any

from illuminerf.workflow.errors import UserError

MAX_ELEMENTS = 2**26
"""Of all vertices, corners and other entries together: a mesh of about ten million triangles."""
_MAX_BYTES = 2**32
_MAX_HEADER = 2**16


def check_claims(path: Path, kind: str) -> None:
    """Refuse a .glb, .gltf, .obj or .ply file that is, or says it is, too large.

    Raises:
        UserError: it is too large, or its header makes no sense.
    """
    size = path.stat().st_size
    claimed = 0
    if size <= _MAX_BYTES:
        with open(path, "rb") as stream:
            head = stream.read(_MAX_HEADER)
            claimed = _of_ply(head) if kind == "ply" else 0
            if kind in ("glb", "gltf"):
                claimed = _of_gltf(path, kind, head + stream.read())
    if size > _MAX_BYTES or claimed > MAX_ELEMENTS:
        raise UserError(
            f"{path} is too large",
            got=f"{size:,} bytes, {claimed:,} entries",
            wanted=f"at most {_MAX_BYTES:,} bytes and {MAX_ELEMENTS:,} entries",
            fix="simplify the mesh",
        )


def _of_ply(head: bytes) -> int:
    return sum(int(count) for count in re.findall(rb"^element\s+\S+\s+(\d{1,18})", head, re.MULTILINE))


def _of_gltf(path: Path, kind: str, content: bytes) -> int:
    """Entries of all accessors, counted as often as nodes show them."""
    try:
        if content[:4] == b"glTF":
            (length,) = struct.unpack_from("<I", content, 12)
            content = content[20 : 20 + length]
        document = json.loads(content)
        counts = [int(accessor["count"]) for accessor in document.get("accessors", [])]
        shown = [int(node.get("mesh", -1)) for node in document.get("nodes", [])]
        used = [_entries(mesh, counts) for mesh in document.get("meshes", [])]
        placed = sum(used[index] for index in shown if 0 <= index < len(used))
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError, struct.error) as error:
        reason = f"{type(error).__name__}: {error}"
        raise UserError(f"{path} is not a readable {kind.upper()} mesh", got=reason, fix="export it again") from error
    if min(counts, default=0) < 0:
        raise UserError(f"{path} is not a readable {kind.upper()} mesh", got="a count below 0", fix="export it again")
    return max(sum(counts), placed)


def _entries(mesh: dict[str, Any], counts: list[int]) -> int:
    """Entries that one mesh takes."""
    total = 0
    for primitive in mesh["primitives"]:
        used = [*primitive.get("attributes", {}).values(), *([primitive["indices"]] if "indices" in primitive else [])]
        total += sum(counts[index] for index in used)
    return total
