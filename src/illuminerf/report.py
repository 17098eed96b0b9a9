"""The one-page HTML report of a run: one file, opens offline, pictures inside."""

import base64
import html
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.evaluation.benchmark_rule import on_white
from illuminerf.scene.environment import EnvironmentMap, chrome_ball
from illuminerf.scene.images import composite, read_exr, read_png, srgb_from_linear
from illuminerf.scene.light_preview import viewing_exposure
from illuminerf.scene.web_page import evenly_spread, picture_row, web_page
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.atomic import read_json, write_bytes

_MAX_PICTURES = 6
_CUE_TITLES = {"diffuse": "diffuse", "ggx_005": "GGX 0.05", "ggx_013": "GGX 0.13", "ggx_034": "GGX 0.34"}


def write_report(
    out: Path,
    run: Path,
    stages: dict[str, Path],
    lights: dict[str, dict[str, Path]],
    scores: dict[str, Any] | None = None,
) -> Path:
    """Gather what the stages made into `out`.

    Args:
        out: the HTML file to write.
        run: the run's folder; its name is the title.
        stages: artefacts all lights share: "capture", "geometry", and "illumination" where there is one.
        lights: for each light's name its artefacts: "cues", "relit", "latent_nerf", "turntable", and the file
            "video" where there is one.
        scores: by light, {"psnr": dB, "ssim": ...}, where there is truth.
    """
    body = [f"<h1>{html.escape(run.resolve().name)}</h1><p class=note>Open IllumiNeRF: one object, relit.</p>"]
    body += [_inputs(stages["capture"]), _geometry(stages["geometry"])]
    if "illumination" in stages:
        body.append(_illumination(stages["illumination"]))
    for name, artefacts in lights.items():
        body.append(_light(name, artefacts, stages["capture"]))
    if scores:
        body.append(_scores(scores))
    body.append(_costs(stages, lights))
    write_bytes(out, web_page(run.resolve().name, "".join(body)))
    return out


def _inputs(capture: Path) -> str:
    files = sorted((capture / "images").glob("*.png"))
    pictures = [(on_white(read_png(path)), path.stem) for path in evenly_spread(files, _MAX_PICTURES)]
    return f"<h2>Input: {len(files)} photographs</h2>{picture_row(pictures)}"


def _geometry(geometry: Path) -> str:
    normals = sorted((geometry / "normals").glob("*.png"))
    pictures = [(on_white(read_png(path)), f"normals {path.stem}") for path in evenly_spread(normals, _MAX_PICTURES)]
    return f"<h2>Geometry</h2>{picture_row(pictures)}"


def _illumination(illumination: Path) -> str:
    caption = "estimated light; photographs, shading, albedo"
    return f"<h2>The photographs' own light</h2>{picture_row([(read_png(illumination / 'preview.png'), caption)])}"


def _light(name: str, artefacts: dict[str, Path], capture: Path) -> str:
    light = EnvironmentMap.load(artefacts["cues"] / "light.exr")
    ball, alpha = chrome_ball(light, 160)
    exposure = viewing_exposure(light.linear_rgb)
    panorama = np.clip(srgb_from_linear(light.linear_rgb * exposure), 0, 1)
    ball_srgb = composite(np.clip(srgb_from_linear(ball * exposure), 0, 1), alpha, 1.0)
    parts = [f"<h2>Light: {html.escape(name)}</h2>"]
    parts.append(
        picture_row(
            [
                (panorama, "the light, left to right: azimuth +180 to -180 degrees"),
                (ball_srgb, "on a mirror ball"),
            ]
        )
    )
    if "video" in artefacts:
        encoded = base64.b64encode(artefacts["video"].read_bytes()).decode()
        parts.append(
            f"<h3>Relit</h3><video controls loop muted autoplay src='data:video/mp4;base64,{encoded}'></video>"
        )
    frames = sorted((artefacts["turntable"] / "images").glob("*.png"))
    parts.append(
        picture_row([(on_white(read_png(path)), f"view {path.stem}") for path in evenly_spread(frames, _MAX_PICTURES)])
    )
    cue_files = sorted((artefacts["cues"] / "cues").glob("*.exr"))
    if cue_files:
        parts.append(
            f"<h3>Radiance cues of photograph {cue_files[0].stem}</h3>{picture_row(_cue_pictures(cue_files[0]))}"
        )
    parts.append(_samples(artefacts["relit"], capture))
    return "".join(parts)


def _cue_pictures(path: Path) -> list[tuple[np.ndarray, str]]:
    channels = read_exr(path)
    pictures = []
    for cue, title in _CUE_TITLES.items():
        linear_rgb = np.stack([channels[f"{cue}.{c}"] for c in "RGB"], -1)
        srgb = np.clip(srgb_from_linear(linear_rgb * viewing_exposure(linear_rgb)), 0, 1)
        pictures.append((np.clip(srgb + 1 - channels["A"][..., None], 0, 1), title))  # premultiplied, over white
    return pictures


def _samples(relit: Path, capture: Path) -> str:
    files = sorted((relit / "samples").glob("*.png"))
    views = sorted({path.stem.rsplit("_", 1)[0] for path in files})
    parts = [f"<h3>Samples of the relighting diffusion model ({len(files)} in all)</h3>"]
    for view in views[:: max(1, len(views) // 2)][:2]:
        photograph = read_png(capture / "images" / f"{view}.png")
        alpha = photograph[..., 3]
        row = [(on_white(photograph), f"photograph {view}")]
        for path in [file for file in files if file.stem.startswith(f"{view}_")][: _MAX_PICTURES - 1]:
            row.append((read_png(path)[..., :3] + (1 - alpha[..., None]), f"sample {path.stem.rsplit('_', 1)[1]}"))
        parts.append(picture_row(row))
    return "".join(parts)


def _scores(scores: dict[str, Any]) -> str:
    rows = "<tr><th>light</th><th>PSNR, dB</th><th>SSIM</th></tr>" + "".join(
        f"<tr><td>{html.escape(light)}</td><td>{values['psnr']:.2f}</td><td>{values['ssim']:.3f}</td></tr>"
        for light, values in scores.items()
    )
    note = "<p class=note>On views that were not photographed, per-channel rescaled as in the TensoIR benchmark.</p>"
    return f"<h2>Scores</h2>{note}<table>{rows}</table>"


def _costs(stages: dict[str, Path], lights: dict[str, dict[str, Path]]) -> str:
    rows = [("all lights", name, path) for name, path in stages.items()]
    rows += [(light, name, path) for light, made in lights.items() for name, path in made.items() if name != "video"]
    lines = []
    for light, name, path in rows:
        metrics = read_metrics(path)
        lines.append(
            f"<tr><td>{html.escape(name.replace('_', ' '))}</td><td>{html.escape(light)}</td>"
            f"<td>{metrics['seconds']:.1f}</td><td>{metrics['peak_memory_gb']:.2f}</td></tr>"
        )
    versions = read_json(next(iter(stages.values())) / "provenance.json")
    note = html.escape(", ".join(f"{name} {version}" for name, version in versions["versions"].items()))
    head = "<tr><th>stage</th><th>light</th><th>seconds</th><th>peak memory, GB</th></tr>"
    note += "; " + html.escape(versions["platform"])
    return f"<h2>Cost</h2><table>{head}{''.join(lines)}</table><p class=note>{note}</p>"
