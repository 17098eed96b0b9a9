"""The one-page HTML report of score files: sortable tables, published figures marked as such, pictures inside."""

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

from illuminerf.evaluation.pictures import FULL_SCALE, CellPictures, ViewPictures, error_colours
from illuminerf.evaluation.published import TENSOIR, gallery_scores
from illuminerf.evaluation.score_files import METRICS, MethodScores, all_cells, cells_of
from illuminerf.evaluation.tables import mean_of
from illuminerf.scene.web_page import STYLE, png_url, small_url, thumbnail, web_page

PICTURE_BYTES = 6_000_000
"""All pictures together, as they stand in the file; they are made smaller until they fit."""
PICTURE_SIDES = (320, 256, 192, 128, 96)
"""Pixels, tried in this order."""
_HEADINGS = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
_DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
_GALLERY = "published renderings, every 20th view"
_STYLE = (
    STYLE
    + """
h2, h3 { line-height: 1.25; overflow-wrap: anywhere } h3 { margin: 1.6rem 0 .3rem }
.wide, .strip { overflow-x: auto; -webkit-overflow-scrolling: touch }
td, th { padding: .3rem .9rem .3rem 0; vertical-align: top; font-variant-numeric: tabular-nums; white-space: nowrap }
td.text, th.text { text-align: left } td.note { text-align: left; white-space: normal; min-width: 14rem; opacity: .75 }
tr.published, tr.reference { font-style: italic } tbody tr:nth-child(even) { background: #8881 }
.mark { font: .75rem system-ui, sans-serif; border: 1px solid var(--line); border-radius: 4px; padding: 0 .3rem }
th button { all: unset; cursor: pointer; font-weight: 600 } th button:focus-visible { outline: 2px solid }
th button::after { content: " \\2195"; opacity: .4 } th[aria-sort] button::after { opacity: 1 }
th[aria-sort=ascending] button::after { content: " \\2191" }
th[aria-sort=descending] button::after { content: " \\2193" }
.strip { display: flex; gap: .6rem; padding-bottom: .5rem } .strip > div { flex: none; width: min(12rem, 60vw) }
.strip img { display: block; width: 100%; height: auto } .strip figure + figure { margin-top: .5rem }
figcaption { overflow-wrap: anywhere } .scale { max-width: 24rem } .scale img { width: 100%; height: 1rem }
.scale div { display: flex; justify-content: space-between; font-size: .8rem }
@media (max-width: 40rem) {
  table { font-size: .8rem } td, th { padding-right: .5rem } th { white-space: normal } th button::after { content: "" }
  td.text { white-space: normal; min-width: 5rem } td.note { min-width: 9rem }
}
"""
)
_SCRIPT = """
for (const table of document.querySelectorAll('table.sortable')) {
  table.tHead.addEventListener('click', (event) => {
    const head = event.target.closest('th');
    if (!head) return;
    const now = head.getAttribute('aria-sort') || '';
    const order = now ? (now === 'ascending' ? 'descending' : 'ascending') : head.dataset.first;
    for (const other of table.tHead.querySelectorAll('th')) other.removeAttribute('aria-sort');
    head.setAttribute('aria-sort', order);
    const sign = order === 'ascending' ? 1 : -1;
    const value = (row) => row.cells[head.cellIndex].dataset.value;
    const isNumber = 'number' in head.dataset;
    const compare = (a, b) => {
      const [x, y] = [value(a), value(b)];
      if (x === '' || y === '') return (x === '') - (y === '');
      return sign * (isNumber ? x - y : x.localeCompare(y, undefined, { numeric: true }));
    };
    const body = table.tBodies[0];
    body.append(...[...body.rows].sort(compare));
  });
}
"""


@dataclass(frozen=True)
class ScoreRow:
    """One line of a score table."""

    scene: str
    light: str
    method: str
    values: dict[str, float] = field(default_factory=dict)
    """By metric; what is not known is absent."""
    conditions: str = ""
    kind: str = "scored"
    """scored, reference (what doing nothing reaches) or published."""


def score_page(methods: Sequence[MethodScores], pictures: Iterable[CellPictures] = (), title: str = "") -> bytes:
    """The whole HTML file; equal inputs give equal bytes.

    Args:
        methods: what the score files say.
        pictures: some views of each scene and light, taken one by one.
        title: plain text.
    """
    title = title or "Relighting scores"
    names = ", ".join(method.name for method in methods)
    body = [f"<h1>{html.escape(title)}</h1><p class=note>Open IllumiNeRF: {html.escape(names)}.</p>"]
    note = "<p class=note>{} Click on a heading to sort.</p>"
    body.append("<h2>Means</h2>" + note.format("Over lights, then over scenes; compare only what covers the same."))
    body.append(_score_table(mean_rows(methods), ("method",)))
    body.append(
        "<h2>Scene by scene and light by light</h2>" + note.format("Higher PSNR and SSIM, lower LPIPS is better.")
    )
    body.append(_score_table(cell_rows(methods), ("scene", "light", "method")))
    body.append(_costs(methods))
    body.append(_gallery(pictures))
    return web_page(title, "".join(body), _STYLE, _SCRIPT)


def mean_rows(methods: Sequence[MethodScores]) -> list[ScoreRow]:
    """Means of the score files, of the input light, and the published ones of the whole benchmark."""
    rows, seen = [], set()
    for method in methods:
        means = {metric: value for metric in METRICS if (value := method.mean(metric)) is not None}
        rows.append(ScoreRow("", "", method.name, means, _covers(method)))
    for method in methods:
        cells = tuple(cells_of(method.input_light))
        psnr = mean_of(method.input_light) if cells else 0.0
        if cells and (cells, f"{psnr:.2f}") not in seen:
            seen.add((cells, f"{psnr:.2f}"))
            rows.append(ScoreRow("", "", "input light", {"psnr": psnr}, f"not relit; as {method.name}", "reference"))
    for row in TENSOIR:
        values = {"psnr": row.psnr, "ssim": row.ssim, "lpips": row.lpips}
        conditions = "; ".join(filter(None, ["4 scenes, 5 lights, 200 views each", row.source, row.note]))
        rows.append(ScoreRow("", "", row.method, values, conditions, "published"))
    return rows


def cell_rows(methods: Sequence[MethodScores]) -> list[ScoreRow]:
    """Each scene and light: the score files, the input light, and published renderings where there are any."""
    rows = []
    for scene, light in all_cells(methods):
        recorded: dict[str, tuple[float, str]] = {}
        for method in methods:
            values = {m: value for m in METRICS if (value := method.value(m, (scene, light))) is not None}
            if values:
                count = method.views.get(scene, {}).get(light)
                views = f"{count} views; " if count else ""
                rows.append(ScoreRow(scene, light, method.name, values, f"{views}rescaled by {_rule(method)}"))
            nothing = method.input_light.get(scene, {}).get(light)
            if nothing is not None:
                recorded.setdefault(f"{nothing:.2f}", (nothing, method.name))
        for psnr, name in recorded.values():
            rows.append(ScoreRow(scene, light, "input light", {"psnr": psnr}, f"not relit; as {name}", "reference"))
        gallery = gallery_scores(scene, light)
        if gallery:
            published = {"IllumiNeRF": gallery.paper, "TensoIR": gallery.tensoir, "input light": gallery.input_light}
            rows += [
                ScoreRow(scene, light, name, {"psnr": psnr}, _GALLERY, "published") for name, psnr in published.items()
            ]
    return rows


def _covers(method: MethodScores) -> str:
    cells = method.cells()
    scenes, lights = (len({cell[index] for cell in cells}) for index in (0, 1))
    counts = sorted({count for views in method.views.values() for count in views.values()})
    views = f", {' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} views each" if counts else ""
    return f"{_plural(scenes, 'scene')}, {_plural(lights, 'light')}{views}; rescaled by {_rule(method)}"


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _rule(method: MethodScores) -> str:
    return {"median": "the median rule", "least_squares": "least squares", "none": "nothing"}[method.rescale]


def _score_table(rows: Sequence[ScoreRow], texts: Sequence[str]) -> str:
    metrics = [metric for metric in METRICS if any(metric in row.values for row in rows)]
    heads = [(text, "ascending", False) for text in texts]
    heads += [(_HEADINGS[metric], "ascending" if metric == "lpips" else "descending", True) for metric in metrics]
    lines = []
    for row in rows:
        cells = [_cell(getattr(row, text), mark="published" if row.kind == "published" and text == "method" else "")
                 for text in texts]  # fmt: skip
        cells += [_number(row.values.get(metric), _DIGITS[metric]) for metric in metrics]
        cells.append(_cell(row.conditions, "note"))
        lines.append(f"<tr class={row.kind}>{''.join(cells)}</tr>")
    return _sortable([*heads, ("conditions", "ascending", False)], lines)


def _costs(methods: Sequence[MethodScores]) -> str:
    stages = sorted({stage for m in methods for seconds in m.seconds.values() for stage in seconds})
    lines = []
    for method in methods:
        for scene in sorted(method.seconds.keys() | method.peak_memory_gb.keys()):
            seconds = method.seconds.get(scene, {})
            total = sum(seconds.values()) if seconds else None
            numbers = [_number(value, 1) for value in [total, *map(seconds.get, stages)]]
            memory = _number(method.peak_memory_gb.get(scene), 2)
            lines.append(f"<tr>{_cell(method.name)}{_cell(scene)}{memory}{''.join(numbers)}</tr>")
    if not lines:
        return ""
    heads = [("method", "ascending", False), ("scene", "ascending", False)]
    heads += [(name, "ascending", True) for name in ("peak memory, GB", "all stages, s", *(f"{s}, s" for s in stages))]
    return f"<h2>Cost</h2><p class=note>Seconds of each stage, added up over lights.</p>{_sortable(heads, lines)}"


def _sortable(heads: Sequence[tuple[str, str, bool]], lines: Sequence[str]) -> str:
    """`heads` are (title, order of the first click, whether the column holds numbers)."""
    cells = "".join(
        f"<th scope=col data-first={first}{' data-number' if number else ' class=text'}>"
        f"<button type=button>{html.escape(title.replace('_', ' '))}</button></th>"
        for title, first, number in heads
    )
    table = f"<table class=sortable><thead><tr>{cells}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    return f"<div class=wide>{table}</div>"


def _cell(text: str, kind: str = "text", mark: str = "") -> str:
    marked = f" <span class=mark>{mark}</span>" if mark else ""
    return f"<td class={kind} data-value='{html.escape(text)}'>{html.escape(text)}{marked}</td>"


def _number(value: float | None, digits: int) -> str:
    return "<td data-value=''>-</td>" if value is None else f"<td data-value='{value!r}'>{value:.{digits}f}</td>"


def _gallery(cells: Iterable[CellPictures]) -> str:
    """Takes one cell at a time and keeps only thumbnails, since whole pictures of a benchmark fill a memory."""
    sections = [(cell.scene, cell.light, cell.notes, [_figures(view, cell) for view in cell.views]) for cell in cells]
    if not sections:
        return ""
    for side in PICTURE_SIDES:
        parts = []
        for scene, light, notes, views in sections:
            note = f"<p class=note>{html.escape(' '.join(notes))}</p>" if notes else ""
            strips = "".join(_strip(*view, side) for view in views)
            parts.append(f"<h3>{html.escape(scene)}, {html.escape(light)}</h3>{note}{strips}")
        if sum(map(len, parts)) <= PICTURE_BYTES:
            break
    return _scale_bar() + "".join(parts)


_Figure = tuple[Image.Image, str, str]
"""Picture, caption, alternative text."""


def _figures(view: ViewPictures, cell: CellPictures) -> tuple[str, list[list[_Figure]]]:
    """The view's name and the columns of its strip, at the largest size."""
    where = f"{view.name} of {cell.scene}"
    columns = []
    if view.input_light is not None:
        columns.append([_figure(view.input_light, "input light", f"{where} under the input light")])
    for shown in view.renderings:
        columns.append(
            [
                _figure(shown.srgb, f"{shown.method}: {shown.psnr:.2f} dB", f"{where} relit by {shown.method}"),
                _figure(shown.error, "error", f"error of {shown.method} in {where}, {cell.light}"),
            ]
        )
    return view.name, [*columns, [_figure(view.truth, "truth", f"{where} under {cell.light}: the truth")]]


def _figure(image: np.ndarray, caption: str, text: str) -> _Figure:
    return thumbnail(image, PICTURE_SIDES[0]), caption, text


def _strip(name: str, columns: list[list[_Figure]], side: int) -> str:
    parts = []
    for column in columns:
        figures = []
        for picture, caption, text in column:
            small = picture.copy()
            small.thumbnail((side, side))
            size = f"width={small.width} height={small.height}"
            figures.append(
                f"<figure><img {size} src='{small_url(small)}' alt='{html.escape(text)}'>"
                f"<figcaption>{html.escape(caption)}</figcaption></figure>"
            )
        parts.append(f"<div>{''.join(figures)}</div>")
    label = html.escape(name)
    return (
        f"<p class=note>{label}</p><div class=strip tabindex=0 role=group aria-label='{label}'>{''.join(parts)}</div>"
    )


def _scale_bar() -> str:
    bar = np.repeat(error_colours(np.linspace(0, FULL_SCALE, 256))[None], 8, axis=0)
    ticks = [f"{FULL_SCALE * part / 4:.4g}" for part in range(5)]
    ticks[-1] = f"{ticks[-1]} and more"
    return (
        "<h2>Pictures</h2><p class=note>Renderings as they are scored: rescaled per channel inside the mask, on white; "
        "those without a score file as they are. "
        "PSNR is that of the one view. Error: |difference| of sRGB values in [0, 1], mean over channels:</p>"
        f"<div class=scale><img src='{png_url(thumbnail(bar, 256))}' alt='colours of the error, black at 0, white "
        f"at {FULL_SCALE}'><div>{''.join(f'<span>{tick}</span>' for tick in ticks)}</div></div>"
    )
