"""Web pages in one file: style and pictures inside, so that they open offline."""

import base64
import html
import io
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from PIL import Image

from illuminerf.scene.images import to_uint8

_Item = TypeVar("_Item")
STYLE = """
:root { color-scheme: light dark; --line: #8884; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0 } h2 { margin-top: 2.2rem; border-bottom: 1px solid var(--line) } p.note { opacity: .75 }
.row { display: flex; flex-wrap: wrap; gap: .6rem; align-items: flex-end } figure { margin: 0 }
figcaption { font-size: .8rem; opacity: .75; text-align: center } img, video { border-radius: 6px; max-width: 100% }
img { image-rendering: auto; height: 9.5rem } img.wide { height: 7rem } img.tall { height: 28rem }
video { height: 18rem; background: #fff }
table { border-collapse: collapse; display: block; overflow-x: auto }
td, th { padding: .25rem .9rem .25rem 0; text-align: right }
td:first-child, th:first-child { text-align: left } th { border-bottom: 1px solid var(--line) }
@media (max-width: 30rem) { table { font-size: .85rem } td, th { padding-right: .5rem } }
"""


def web_page(title: str, body: str, style: str = STYLE, script: str = "", refresh_seconds: int = 0) -> bytes:
    """The whole file; `title` is plain text, `body` HTML. A browser loads it anew after `refresh_seconds`, unless 0."""
    refresh = f"<meta http-equiv=refresh content={refresh_seconds}>" if refresh_seconds else ""
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        f"{refresh}<title>{html.escape(title)} - Open IllumiNeRF</title><style>{style}</style>"
        f"<body>{body}{f'<script>{script}</script>' if script else ''}</body></html>\n"
    ).encode()


def evenly_spread(items: Sequence[_Item], count: int) -> list[_Item]:
    """At most `count` of `items`, the first and the last among them."""
    return [items[int(i)] for i in np.linspace(0, len(items) - 1, min(len(items), count))] if items else []


def picture_row(pictures: list[tuple[np.ndarray, str]]) -> str:
    """(float [height, width, 3 or 4] in [0, 1], caption) side by side."""
    figures = "".join(
        f"<figure><img {_shape_class(image)} "
        f"src='{png_url(thumbnail(image, 640))}' "
        f"alt='{html.escape(title)}'><figcaption>{html.escape(title)}</figcaption></figure>"
        for image, title in pictures
    )
    return f"<div class=row>{figures}</div>"


def _shape_class(image: np.ndarray) -> str:
    height, width = image.shape[:2]
    return "class=wide" if width > 1.6 * height else "class=tall" if height > 1.6 * width else ""


def thumbnail(image: np.ndarray, longest_side: int) -> Image.Image:
    """Float [height, width, 3 or 4] in [0, 1] at 8 bits and no more than `longest_side` pixels."""
    picture = Image.fromarray(to_uint8(image))
    picture.thumbnail((longest_side, longest_side))
    return picture


def png_url(picture: Image.Image) -> str:
    """`picture` as a data: URL, without loss."""
    return _data_url("png", _encoded(picture, "PNG", optimize=True))


def small_url(picture: Image.Image) -> str:
    """`picture`, RGB, as a data: URL: JPEG of high quality, or PNG where that is no larger."""
    exact = _encoded(picture, "PNG", optimize=True)
    lossy = _encoded(picture, "JPEG", quality=88, subsampling=0)
    return _data_url("png", exact) if len(exact) <= len(lossy) else _data_url("jpeg", lossy)


def _encoded(picture: Image.Image, kind: str, **options: int) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return buffer.getvalue()


def _data_url(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
