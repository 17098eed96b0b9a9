"""Large JSON objects entry by entry, in bounded memory, gzipped or not."""

import gzip
import json
import zlib
from collections.abc import Iterator
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from illuminerf.workflow.errors import UserError

_CHUNK = 2**20
_MAX_ENTRY = 32 * 2**20
"""Characters that one entry may take."""
_SPACE = " \t\r\n"
_AFTER_VALUE = ",:}" + _SPACE


def json_entries(path: Path) -> Iterator[tuple[str, Any]]:
    """The entries of the JSON object in `path` (`.gz`: gzipped), one at a time, in the file's order.

    Raises:
        UserError: missing, cut off, not an object, or with an entry beyond 32 MB.
    """
    opener = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rt", encoding="utf-8") as file:
            yield from _entries(file)
    except (OSError, EOFError, ValueError, RecursionError, zlib.error) as error:
        raise UserError(
            f"{path} is not a readable JSON object", got=f"{type(error).__name__}: {error}", fix="download it again"
        ) from error


class _Window:
    """A sliding part of a text file."""

    def __init__(self, file: TextIOWrapper) -> None:
        self._file, self.text, self.position = file, "", 0

    def refill(self) -> bool:
        """Drop what was read and append more; False at the end of the file."""
        if len(self.text) - self.position > _MAX_ENTRY:
            raise ValueError("an entry that is too long")
        more = self._file.read(max(_CHUNK, len(self.text) - self.position))
        self.text, self.position = self.text[self.position :] + more, 0
        return bool(more)

    def next_sign(self) -> str:
        """The next character that is no space, not taken yet; "" at the end."""
        while True:
            while self.position < len(self.text) and self.text[self.position] in _SPACE:
                self.position += 1
            if self.position < len(self.text):
                return self.text[self.position]
            if not self.refill():
                return ""

    def take(self, wanted: str) -> None:
        """Step over the character `wanted`."""
        if self.next_sign() != wanted:
            raise ValueError(f"{self.next_sign() or 'the end'!r} where {wanted!r} should be")
        self.position += 1

    def value(self, decoder: json.JSONDecoder) -> Any:
        """The JSON value that begins here."""
        self.next_sign()
        while True:
            try:
                found, end = decoder.raw_decode(self.text, self.position)
            except ValueError:  # kept by no name: it holds the text, and would hold itself through this frame
                if not self.refill():
                    raise
                continue
            # a number cut off by the window's end is a number too: -1 of -1.5
            if end < len(self.text) and self.text[end] in _AFTER_VALUE:
                self.position = end
                return found
            if not self.refill():
                raise ValueError("a value without an end")


def _entries(file: TextIOWrapper) -> Iterator[tuple[str, Any]]:
    window, decoder = _Window(file), json.JSONDecoder()
    window.take("{")
    if window.next_sign() == "}":
        return
    while True:
        key = window.value(decoder)
        if not isinstance(key, str):
            raise ValueError(f"the key {key!r}")
        window.take(":")
        yield key, window.value(decoder)
        if window.next_sign() == "}":
            return
        window.take(",")
