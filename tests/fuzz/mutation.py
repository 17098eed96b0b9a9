"""Inputs that are almost right: bytes, JSON and containers of both, changed at random by a seed."""

import contextlib
import copy
import json
import random
import struct
import zlib
from typing import Any

_INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 65_535, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_HOSTILE: tuple[Any, ...] = (
    None, True, -1, 0, 1, 3.5, -0.0, 1e-320, 1e308, 10**9, 2**31, 2**63, -(2**63), 10**400, float("nan"), float("inf"),
    "", "x", "\0", "../../outside", "/etc/hostname", "a" * 5000, "NaN", "data:;base64,AAAA", "é\u202e\ud83d", [], [[]],
    [1] * 17, {}, {"": {}}, [None] * 4, "1e999", "0x10", " 1 ", [[1e300] * 4] * 4, "images/.", "http://host/x",
)  # fmt: skip


def mutated_bytes(content: bytes, draw: random.Random, other: bytes = b"") -> bytes:
    """A few changes to `content`: bits, numbers, pieces cut out, doubled, moved or taken from `other`."""
    data = bytearray(content)
    for _ in range(1 + min(int(draw.expovariate(0.7)), 12)):
        place = draw.randrange(len(data)) if data else 0
        length = 1 + min(int(draw.expovariate(0.05)), 400)
        match draw.randrange(9):
            case 0 if data:
                data[place] ^= 1 << draw.randrange(8)
            case 1 if data:
                data[place] = draw.randrange(256)
            case 2:
                width, order = draw.choice(("B", "H", "I", "Q")), draw.choice("<>")
                number = draw.choice(_INTEGERS) & (2 ** (8 * struct.calcsize(width)) - 1)
                packed = struct.pack(order + width, number)
                data[place : place + len(packed)] = packed
            case 3:
                del data[place : place + length]
            case 4:
                data[place:place] = data[place : place + length]
            case 5:
                data[place:place] = draw.randbytes(length)
            case 6 if other:
                start = draw.randrange(len(other))
                data[place : place + length] = other[start : start + length]
            case 7:
                data = data[:place]
            case 8:
                target = draw.randrange(len(data) + 1)
                data[target : target + length] = data[place : place + length]
    return bytes(data)


def mutated_json(text: bytes, draw: random.Random, other: bytes = b"") -> bytes:
    """JSON with a few values replaced, dropped, doubled or exchanged; now and then just broken text."""
    if draw.random() >= 0.1:
        with contextlib.suppress(ValueError, RecursionError):  # some of what is spoilt again is JSON no longer
            return _changed_json(text, draw)
    return mutated_bytes(text, draw, other)


def _changed_json(text: bytes, draw: random.Random) -> bytes:
    whole: Any = [json.loads(text)]
    for _ in range(1 + min(int(draw.expovariate(0.8)), 6)):
        parent, key = _place(whole, draw)
        if isinstance(parent[key], (int, float)) and abs(parent[key]) < 1e300 and draw.random() < 0.4:
            parent[key] = parent[key] * draw.choice((-1, 0.5, 2, 1e3, 1e9, 1 + 1e-9)) + draw.choice((0, 1, -1))
        elif isinstance(parent[key], str) and draw.random() < 0.4:
            parent[key] = mutated_bytes(parent[key].encode("utf-8", "replace"), draw).decode("utf-8", "replace")
        elif draw.random() < 0.2 and parent is not whole:
            if isinstance(parent, dict):
                del parent[key]
            else:
                parent.insert(key, parent[key])
        elif draw.random() < 0.15:
            source, name = _place(whole, draw)
            parent[key] = json.loads(_text(source[name]))
        else:
            parent[key] = copy.deepcopy(draw.choice(_HOSTILE))
    if draw.random() < 0.005:
        return b"[" * 100_000
    return _text(whole[0])


def _text(value: Any) -> bytes:
    return json.dumps(value).encode("utf-8", "replace")


def _place(whole: list[Any], draw: random.Random) -> tuple[Any, Any]:
    """A container and a key or index in it, all depths alike."""
    parent: Any = whole
    key: Any = 0
    while isinstance(parent[key], (dict, list)) and len(parent[key]) and draw.random() < 0.8:
        parent = parent[key]
        key = draw.choice(list(parent)) if isinstance(parent, dict) else draw.randrange(len(parent))
    return parent, key


def mutated_png(content: bytes, draw: random.Random, other: bytes = b"") -> bytes:
    """A PNG whose chunks are changed and whose checksums mostly fit again."""
    if draw.random() < 0.3 or not content.startswith(b"\x89PNG"):
        return mutated_bytes(content, draw, other)
    chunks, position = [], 8
    while position + 12 <= len(content):
        (length,) = struct.unpack(">I", content[position : position + 4])
        chunks.append([content[position + 4 : position + 8], content[position + 8 : position + 8 + length]])
        position += 12 + length
    if not chunks:
        return mutated_bytes(content, draw, other)
    for _ in range(draw.randint(1, 2)):
        chosen = draw.choice(chunks)
        if chosen[0] == b"IDAT" and draw.random() < 0.5:
            chosen[1] = zlib.compress(mutated_bytes(_inflated(chosen[1]), draw))
        else:
            chosen[1] = mutated_bytes(chosen[1], draw, other)
    if draw.random() < 0.2:
        chunks.insert(draw.randrange(len(chunks)), draw.choice(chunks))
    parts = (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )
    return content[:8] + b"".join(parts)


def _inflated(packed: bytes) -> bytes:
    try:
        return zlib.decompressobj().decompress(packed, 2**20)
    except zlib.error:
        return packed


def mutated_glb(content: bytes, draw: random.Random, other: bytes = b"") -> bytes:
    """A GLB whose JSON or binary chunk is changed, with lengths that mostly fit."""
    if draw.random() < 0.2 or len(content) < 20 or content[:4] != b"glTF":
        return mutated_bytes(content, draw, other)
    (size,) = struct.unpack("<I", content[12:16])
    text, rest = content[20 : 20 + size], content[28 + size :]
    if draw.random() < 0.8:
        text = mutated_json(text, draw)
    else:
        rest = mutated_bytes(rest, draw)
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(rest), b"BIN\0") + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def mutated_safetensors(content: bytes, draw: random.Random, other: bytes = b"") -> bytes:
    """Safetensors whose JSON header is changed, with its length right again."""
    if draw.random() < 0.3 or len(content) < 8:
        return mutated_bytes(content, draw, other)
    (size,) = struct.unpack("<Q", content[:8])
    if size > len(content):
        return mutated_bytes(content, draw, other)
    header = mutated_json(content[8 : 8 + size], draw)
    length = len(header) if draw.random() < 0.95 else draw.choice((2**40, 2**63, 10**8))
    return struct.pack("<Q", length) + header + content[8 + size :]
