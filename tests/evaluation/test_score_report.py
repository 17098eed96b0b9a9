"""Score files, the page and the LaTeX tables made of them, on made-up scores."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from illuminerf.evaluation.latex_tables import escaped, latex_tables
from illuminerf.evaluation.pictures import FULL_SCALE, CellPictures, Rendering, ViewPictures, error_colours, error_map
from illuminerf.evaluation.published import TENSOIR, gallery_scores
from illuminerf.evaluation.score_files import MethodScores, read_score_files
from illuminerf.evaluation.score_report import PICTURE_SIDES, cell_rows, mean_rows, score_page
from illuminerf.workflow.errors import UserError

STRANGE = "a<b> & 'c' \"d\" 50%_#$~^{}\\"


def content(**changed: Any) -> dict[str, Any]:
    whole: dict[str, Any] = {
        "rescale": "median",
        "psnr": {"hotdog": {"city": 21.504, "night": 24.0}},
        "ssim": {"hotdog": {"city": 0.91, "night": 0.93}},
        "scale": {"hotdog": {"city": [1.0, 1.0, 1.0], "night": [2.0, 1.0, 1.0]}},
        "views": {"hotdog": {"city": 20, "night": 10}},
        "input_light": {"hotdog": {"city": 27.44, "night": 24.85}},
        "seconds": {"hotdog": {"geometry": 86.4, "cues": 22.5}},
        "peak_memory_gb": {"hotdog": 1.27},
        "mean": {"psnr": 0.0},
    }
    return {key: value for key, value in {**whole, **changed}.items() if value is not None}


def write(folder: Path, **changed: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scores.json").write_text(json.dumps(content(**changed)))
    return folder


@pytest.fixture
def methods(tmp_path: Path) -> list[MethodScores]:
    """Two over the same cells, the second with LPIPS, and one over a single cell."""
    better = {"psnr": {"hotdog": {"city": 21.496, "night": 26.0}}, "ssim": {"hotdog": {"city": 0.95, "night": 0.92}}}
    one_cell = {key: {"hotdog": {"city": content()[key]["hotdog"]["city"]}} for key in ("ssim", "scale", "views")}
    return read_score_files(
        [
            write(tmp_path / "ours"),
            write(tmp_path / "theirs", **better, lpips={"hotdog": {"city": 0.1, "night": 0.2}}, input_light=None),
            write(tmp_path / "third", psnr={"hotdog": {"city": 19.0}}, **one_cell, seconds=None),
        ]
    )


class Tables(HTMLParser):
    """[table][row][cell] of text, and the attributes of all tags."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.tables: list[list[list[str]]] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open = False
        self.feed(page.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self.open = True

    def handle_endtag(self, tag: str) -> None:
        self.open = self.open and tag not in ("td", "th")

    def handle_data(self, data: str) -> None:
        if self.open:
            self.tables[-1][-1][-1] += data

    def attributes(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def test_the_page_has_every_score_and_says_whose_it_is(methods: list[MethodScores]) -> None:
    means, cells, costs = Tables(score_page(methods)).tables
    assert means[0] == ["method", "PSNR, dB", "SSIM", "LPIPS", "conditions"]
    conditions = "1 scene, 2 lights, 10 to 20 views each; rescaled by the median rule"
    assert means[1] == ["ours", "22.75", "0.920", "-", conditions]
    assert means[2][:4] == ["theirs", "23.75", "0.935", "0.150"]
    assert ["input light", "26.15", "-", "-", "not relit; as ours"] in means
    published = [row for row in means if row[0].endswith(" published")]
    assert len(published) == len(TENSOIR)
    assert published[1][:4] == ["IllumiNeRF published", "29.71", "0.947", "0.072"]
    assert "16 A100" in published[1][4] and "4 scenes" in published[1][4]
    assert ["hotdog", "city", "ours", "21.50", "0.910", "-", "20 views; rescaled by the median rule"] in cells
    assert ["hotdog", "night", "theirs", "26.00", "0.920", "0.200", "10 views; rescaled by the median rule"] in cells
    assert [row[:4] for row in cells if row[1] == "city" and "input" in row[2]] == [
        ["hotdog", "city", "input light", "27.44"],
        ["hotdog", "city", "input light published", "26.66"],
    ]
    assert not [row for row in cells if row[2] == "third" and row[1] == "night"]
    assert costs[0] == ["method", "scene", "peak memory, GB", "all stages, s", "cues, s", "geometry, s"]
    assert costs[1] == ["ours", "hotdog", "1.27", "108.9", "22.5", "86.4"]
    assert costs[3] == ["third", "hotdog", "1.27", "-", "-", "-"]


def test_input_lights_that_differ_are_told_apart(tmp_path: Path) -> None:
    other = write(tmp_path / "small", input_light={"hotdog": {"city": 25.0, "night": 24.85}})
    both = read_score_files([write(tmp_path / "ours"), other])
    city = [row for row in cell_rows(both) if row.light == "city" and row.kind == "reference"]
    assert [(row.values["psnr"], row.conditions) for row in city] == [
        (27.44, "not relit; as ours"),
        (25.0, "not relit; as small"),
    ]
    assert len([row for row in cell_rows(both) if row.light == "night" and row.kind == "reference"]) == 1
    assert len([row for row in mean_rows(both) if row.kind == "reference"]) == 2
    assert "input light (small) & 25.00 & 24.85" in latex_tables(both)
    part = write(tmp_path / "part", input_light={"hotdog": {"city": 27.44}})
    text = latex_tables(read_score_files([part, tmp_path / "ours"]))
    assert text.count("input light & 27.44 & 24.85 & 26.15") == text.count("input light") == 1


def test_columns_can_be_sorted(methods: list[MethodScores]) -> None:
    page = score_page(methods)
    tables = Tables(page)
    heads = tables.attributes("th")
    assert [head["data-first"] for head in heads[:5]] == [
        "ascending",
        "descending",
        "descending",
        "ascending",
        "ascending",
    ]
    assert ["data-number" in head for head in heads[:5]] == [False, True, True, True, False]
    assert all("data-value" in cell for cell in tables.attributes("td"))
    values = [cell["data-value"] for cell in tables.attributes("td")[:5]]
    assert values[0] == "ours" and float(values[1] or "") == pytest.approx(22.752) and values[3] == ""
    assert len(tables.attributes("script")) == 1 and page.count(b"<button type=button>") == len(heads)


def test_the_page_needs_no_network(methods: list[MethodScores]) -> None:
    page = score_page(methods).decode()
    assert "http" not in page and "@import" not in page and "src=" not in page


def view(name: str = "test_000", size: int = 16) -> ViewPictures:
    generator = np.random.default_rng(1)
    truth, wrong = generator.uniform(size=(2, size, size, 3))
    renderings = (Rendering(STRANGE, wrong, error_map(wrong, truth), 7.5),)
    return ViewPictures(name, None, renderings, truth)


def test_strange_names_are_escaped_in_html(tmp_path: Path) -> None:
    folder = write(tmp_path / STRANGE.replace("\\", ""))
    page = score_page(read_score_files([folder]), [CellPictures("hotdog", "<i>", (view(),), ("<u>.",))], "<s>")
    tables = Tables(page)
    assert tables.tables[0][1][0] == folder.name
    assert tables.attributes("td")[0]["data-value"] == folder.name
    assert not {"b", "i", "u", "s"} & {tag for tag, _ in tables.tags}
    assert f"test_000 of hotdog relit by {STRANGE}" in [image.get("alt") for image in tables.attributes("img")]


def test_pictures_have_texts_and_sizes_and_what_is_missing_is_noted(methods: list[MethodScores]) -> None:
    cell = CellPictures("hotdog", "city", (view(),), ("theirs has no pictures of it, or no score.",))
    page = score_page(methods, [cell])
    images = Tables(page).attributes("img")
    assert len(images) == 4  # the scale, a rendering, its error, the truth
    assert all(image["alt"] and (image["src"] or "").startswith("data:image/") for image in images)
    assert [image["width"] for image in images[1:]] == ["16"] * 3
    text = page.decode()
    assert "theirs has no pictures of it" in text and ": 7.50 dB" in text
    assert f"{FULL_SCALE} and more" in text and "<span>0.125</span>" in text
    assert score_page(methods, [cell]) == page


def test_many_large_pictures_are_made_smaller(methods: list[MethodScores], monkeypatch: pytest.MonkeyPatch) -> None:
    cell = CellPictures("hotdog", "city", (view(size=400),), ())
    widths = [Tables(score_page(methods, [cell])).attributes("img")[1]["width"]]
    monkeypatch.setattr("illuminerf.evaluation.score_report.PICTURE_BYTES", 100_000)
    page = score_page(methods, [cell])
    widths.append(Tables(page).attributes("img")[1]["width"])
    assert widths[0] == str(PICTURE_SIDES[0]) and widths[1] in map(str, PICTURE_SIDES[2:])
    assert len(page) < 130_000


def test_latex_has_the_numbers_and_the_best_is_bold(methods: list[MethodScores]) -> None:
    text = latex_tables(methods)
    psnr, ssim, lpips = re.findall(r"\\begin\{table\}.*?\\end\{table\}", text, re.DOTALL)
    assert "& \\multicolumn{2}{c}{hotdog} & \\\\\n\\cmidrule(lr){2-3}\n & city & night & mean \\\\" in psnr
    assert "ours & \\textbf{21.50} & 24.00 & 22.75 \\\\" in psnr  # equal as printed: both are best
    assert "theirs & \\textbf{21.50} & \\textbf{26.00} & \\textbf{23.75} \\\\" in psnr
    assert "third & 19.00 & -- & -- \\\\" in psnr
    assert "input light & 27.44 & 24.85 & 26.15 \\\\" in psnr
    assert "IllumiNeRF$^\\ast$ & -- & -- & 29.71 \\\\" in psnr
    gallery = gallery_scores("hotdog", "city")
    assert gallery is not None and f"IllumiNeRF$^\\dagger$ & {gallery.paper:.2f} & 29.73 & 27.76" in psnr
    assert "ours & 0.910 & \\textbf{0.930} & 0.920 \\\\" in ssim and "dagger" in psnr and "dagger" not in ssim
    assert "theirs & 0.100 & 0.200 & 0.150 \\\\" in lpips  # nobody to compete with
    assert text.count("\\toprule") == text.count("\\bottomrule") == 3


def test_lower_lpips_is_bold(tmp_path: Path) -> None:
    values = ({"city": 0.1, "night": 0.3}, {"city": 0.2, "night": 0.25})
    folders = [write(tmp_path / str(i), lpips={"hotdog": value}) for i, value in enumerate(values)]
    text = latex_tables(read_score_files(folders))
    assert "0 & \\textbf{0.100} & 0.300 & \\textbf{0.200}" in text and "1 & 0.200 & \\textbf{0.250} & 0.225" in text


def test_strange_names_are_escaped_in_latex(tmp_path: Path) -> None:
    assert escaped("a_b & 5% #1 $x$ {y}") == "a\\_b \\& 5\\% \\#1 \\$x\\$ \\{y\\}"
    assert escaped("~^\\<>|") == (
        "\\textasciitilde{}\\textasciicircum{}\\textbackslash{}\\textless{}\\textgreater{}\\textbar{}"
    )
    assert escaped("[2pt]*\nb") == "{[}2pt{]}{*} b"
    text = latex_tables(read_score_files([write(tmp_path / "[2pt]_x%")]))
    assert "\n{[}2pt{]}\\_x\\% & 21.50" in text
    for line in text.splitlines():
        if line.endswith("\\\\"):  # every row has as many columns as the table
            spanned = sum(int(width) - 1 for width in re.findall(r"multicolumn\{(\d+)\}", line))
            assert len(re.findall(r"(?<!\\)&", line)) + spanned == 3


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"psnr": 21.0}, "not a score file"),
        ({"psnr": {}}, "no scene and light"),
        ({"ssim": None}, "no ssim"),
        ({"ssim": {"hotdog": {"city": 0.9}}}, "ssim and psnr are of different"),
        ({"lpips": {"lego": {"city": 0.9}}}, "lpips and psnr are of different"),
        ({"psnr": {"hotdog": {"city": "21", "night": 1.0}}}, "'21', not a number"),
        ({"psnr": {"hotdog": {"city": float("nan"), "night": 1.0}}}, "nan, not a number"),
        ({"rescale": "guess"}, "rescale 'guess'"),
        ({"rescale": None}, "KeyError: 'rescale'"),
        ({"scale": {"hotdog": {"city": [1.0], "night": [1.0]}}}, "without three factors"),
        ({"seconds": [1.0]}, "not a score file"),
    ],
)
def test_unknown_score_files_are_refused(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        read_score_files([write(tmp_path / "ours", **changed)])
    assert error.value.got and error.value.wanted and error.value.fix


def test_missing_damaged_and_equally_named_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a score file is missing.*Fix"):
        read_score_files([tmp_path])
    with pytest.raises(UserError, match="a score file is missing.*absent.json"):
        read_score_files([tmp_path / "absent.json"])
    with pytest.raises(UserError, match="nothing to report"):
        read_score_files([])
    (tmp_path / "cut.json").write_text(json.dumps(content())[:90])
    with pytest.raises(UserError, match="not valid JSON"):
        read_score_files([tmp_path / "cut.json"])
    with pytest.raises(UserError, match="two methods have the same name.*'ours'.*rename"):
        read_score_files([write(tmp_path / "a" / "ours"), write(tmp_path / "b" / "ours")])


def test_files_of_other_names_are_methods_too(tmp_path: Path) -> None:
    (tmp_path / "published.json").write_text(json.dumps(content(views=None)))
    both = read_score_files([tmp_path / "published.json", write(tmp_path / "ours") / "scores.json"])
    assert [method.name for method in both] == ["published", "ours"]
    assert mean_rows(both)[0].conditions == "1 scene, 2 lights; rescaled by the median rule"


def test_error_colours_get_lighter_in_proportion_to_the_error() -> None:
    colours = error_colours(np.linspace(0, FULL_SCALE, 65)).astype(np.float64)
    luminance = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4) @ (
        0.2126, 0.7152, 0.0722,
    )  # fmt: skip
    assert np.diff(luminance).min() > 0
    lightness = np.cbrt(luminance)
    np.testing.assert_allclose(lightness, np.linspace(0, 1, 65), atol=0.1)
    hot = np.clip(np.stack([3 * np.linspace(0, 1, 65) - i for i in range(3)], -1), 0, 1)  # black, red, yellow, white
    assert np.abs(np.cbrt(hot**2.2 @ (0.2126, 0.7152, 0.0722)) - np.linspace(0, 1, 65)).max() > 0.2


def test_equal_pictures_have_no_error_and_others_have() -> None:
    truth = np.random.default_rng(0).uniform(size=(16, 16, 3))
    assert error_map(truth, truth).max() == 0
    wrong = truth.copy()
    wrong[3, 4] = 1 - np.round(truth[3, 4])
    drawn = error_map(wrong, truth)
    assert drawn[3, 4].max() > 0.5 and drawn.sum() == drawn[3, 4].sum()


def test_inverse_rendering_of_a_run_is_a_method_too(tmp_path: Path) -> None:
    run = write(tmp_path / "ours")
    write(
        run / "inverse_rendering",
        psnr={"hotdog": {"city": 20.125, "night": 25.5}},
        seconds={"hotdog": {"materials": 61.5}},
    )
    found = read_score_files([run, run / "inverse_rendering"])
    assert [method.name for method in found] == ["ours", "ours, inverse rendering"]
    assert "20.12" in latex_tables(found)
    page = score_page(found).decode()
    assert "ours, inverse rendering" in page and "61.5" in page
    assert [method.name for method in read_score_files([write(tmp_path / "alone")])] == ["alone"]
