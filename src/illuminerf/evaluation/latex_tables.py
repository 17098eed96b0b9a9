"""Score tables for a paper: LaTeX with booktabs and no other package."""

from collections.abc import Sequence

from illuminerf.evaluation.published import TENSOIR, gallery_scores
from illuminerf.evaluation.score_files import METRICS, Cell, MethodScores, all_cells
from illuminerf.evaluation.tables import mean_of

DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
LOWER_IS_BETTER = ("lpips",)
_CAPTIONS = {
    "psnr": "PSNR in dB, higher is better",
    "ssim": "SSIM, higher is better",
    "lpips": "LPIPS, lower is better",
}
_SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "[": "{[}", "]": "{]}", "*": "{*}",
} | {character: f"\\{character}" for character in "{}$&#_%"}  # fmt: skip
_Row = tuple[str, list[float | None]]
"""A label, already LaTeX, and one value per column, the mean last."""


def escaped(text: str) -> str:
    """`text` as LaTeX prints it; also safe as the first thing after a line break of a table."""
    return "".join(_SPECIAL.get(character, character) for character in " ".join(text.split()))


def latex_tables(methods: Sequence[MethodScores]) -> str:
    """One table per metric that any of `methods` has: methods by (scene, light), and the mean.

    The best of `methods`, as printed, is bold where two or more compete. A method that was not scored on all of the
    columns has no mean, since it would be one over other cells.
    """
    present = [metric for metric in METRICS if any(metric in method.metrics for method in methods)]
    head = "% Made by illuminerf benchmark report; needs \\usepackage{booktabs}.\n"
    return head + "\n".join(_table(metric, methods, all_cells(methods)) for metric in present)


def _table(metric: str, methods: Sequence[MethodScores], cells: list[Cell]) -> str:
    ours = [_row(method.name, [method.value(metric, cell) for cell in cells], cells) for method in methods]
    references = _references(methods, cells) if metric == "psnr" else []
    published = [(f"{escaped(row.method)}$^\\ast$", [*[None] * len(cells), getattr(row, metric)]) for row in TENSOIR]
    groups = [[_line(label, texts) for label, texts in _with_bold(ours, metric)]]
    groups += [[_line(label, _texts(values, metric)) for label, values in rows] for rows in (references, published)]
    scenes = list(dict.fromkeys(scene for scene, _ in cells))
    widths = [sum(scene == other for other, _ in cells) for scene in scenes]
    spans, rules, column = [], [], 2
    for scene, width in zip(scenes, widths, strict=True):
        spans.append(f"\\multicolumn{{{width}}}{{c}}{{{escaped(scene)}}}")
        rules.append(f"\\cmidrule(lr){{{column}-{column + width - 1}}}")
        column += width
    gallery = "; $^\\dagger$~published renderings, every 20th view" if "^\\dagger" in "".join(groups[1]) else ""
    body = "\\midrule\n".join("".join(group) for group in groups if group)
    return (
        "\\begin{table}\n\\centering\\footnotesize\\setlength{\\tabcolsep}{4pt}\n"
        f"\\caption{{Relighting by the TensoIR benchmark's rule: {_CAPTIONS[metric]}. "
        f"$^\\ast$~published, over four scenes and five lights{gallery}.}}\n"
        f"\\begin{{tabular}}{{l{'r' * (len(cells) + 1)}}}\n\\toprule\n"
        f" & {' & '.join(spans)} & \\\\\n{''.join(rules)}\n"
        f" & {' & '.join(escaped(light) for _, light in cells)} & mean \\\\\n\\midrule\n"
        f"{body}\\bottomrule\n\\end{{tabular}}\n\\end{{table}}\n"
    )


def _references(methods: Sequence[MethodScores], cells: list[Cell]) -> list[_Row]:
    """What doing nothing scores, as the score files tell, and the gallery's renderings."""
    recorded: list[tuple[list[str], list[float | None]]] = []
    for method in methods:
        values = [method.input_light.get(scene, {}).get(light) for scene, light in cells]
        if all(value is None for value in values):
            continue
        same = next((group for group in recorded if _agree(group[1], values)), None)
        if same is None:
            recorded.append(([method.name], values))
        else:
            same[0].append(method.name)
            same[1][:] = [new if old is None else old for old, new in zip(same[1], values, strict=True)]
    rows = []
    for names, values in recorded:
        rows.append(_row("input light" + (f" ({', '.join(names)})" if len(recorded) > 1 else ""), values, cells))
    known = [gallery_scores(*cell) for cell in cells]
    if any(known):
        for label, field in (("IllumiNeRF", "paper"), ("TensoIR", "tensoir")):
            values = [getattr(row, field) if row else None for row in known]
            rows.append((f"{label}$^\\dagger$", _row("", values, cells)[1]))
    return rows


def _agree(some: Sequence[float | None], others: Sequence[float | None]) -> bool:
    pairs = zip(_texts(some, "psnr"), _texts(others, "psnr"), strict=True)
    return all(one == other or "--" in (one, other) for one, other in pairs)


def _row(name: str, values: list[float | None], cells: list[Cell]) -> _Row:
    table: dict[str, dict[str, float]] = {}
    for (scene, light), value in zip(cells, values, strict=True):
        if value is not None:
            table.setdefault(scene, {})[light] = value
    return escaped(name), [*values, mean_of(table) if None not in values else None]


def _with_bold(rows: list[_Row], metric: str) -> list[tuple[str, list[str]]]:
    printed = [_texts(values, metric) for _, values in rows]
    for column in range(len(printed[0])):
        rivals = [float(texts[column]) for texts in printed if texts[column] != "--"]
        if len(rivals) > 1:
            best = min(rivals) if metric in LOWER_IS_BETTER else max(rivals)
            for texts in printed:
                if texts[column] != "--" and float(texts[column]) == best:
                    texts[column] = f"\\textbf{{{texts[column]}}}"
    return [(label, texts) for (label, _), texts in zip(rows, printed, strict=True)]


def _texts(values: Sequence[float | None], metric: str) -> list[str]:
    return ["--" if value is None else f"{value:.{DIGITS[metric]}f}" for value in values]


def _line(label: str, texts: Sequence[str]) -> str:
    return f"{label} & {' & '.join(texts)} \\\\\n"
