"""The page that shows whether a capture's poses and masks are right: cameras in 3D, outlines over photographs.

One file that opens offline. Drag turns the picture, the wheel zooms, and a click on a camera goes to its photograph.
"""

import html
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy import ndimage

from illuminerf.data.capture_warnings import Quality, largest_gap
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.web_page import STYLE, small_url, web_page

_MAX_POINTS = 4000
_OUTLINE, _PALE = np.array([255, 40, 120], np.uint8), 0.5
_PAGE_STYLE = (
    STYLE
    + """
#world { width: 100%; height: min(28rem, 60vh); border: 1px solid var(--line); border-radius: 6px; cursor: grab }
#world { touch-action: none }
.row img { height: auto; width: 9.5rem } figure:target { outline: 3px solid #ff2878; border-radius: 6px }
ul.warnings { border-left: 4px solid #e0a000; padding: .4rem 0 .4rem 2rem }
p.good { border-left: 4px solid #30a050; padding: .4rem 1rem }
"""
)
_SCRIPT = """
const data = JSON.parse(document.getElementById('cameras').textContent);
const canvas = document.getElementById('world'), pen = canvas.getContext('2d');
let azimuth = -1.1, elevation = 0.45, zoom = 1, chosen = -1;
function seen(p) {
  const ca = Math.cos(azimuth), sa = Math.sin(azimuth), ce = Math.cos(elevation), se = Math.sin(elevation);
  const x = -sa * p[0] + ca * p[1], depth = ca * p[0] + sa * p[1];
  const near = data.reach * 3 / (data.reach * 3 - (ce * depth + se * p[2]));
  const unit = zoom * 0.42 * Math.min(canvas.width, canvas.height) / data.reach;
  return [canvas.width / 2 + unit * near * x, canvas.height / 2 - unit * near * (ce * p[2] - se * depth)];
}
function line(a, b) { const p = seen(a), q = seen(b); pen.moveTo(p[0], p[1]); pen.lineTo(q[0], q[1]); }
function draw() {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
  const dark = matchMedia('(prefers-color-scheme: dark)').matches;
  pen.lineWidth = ratio; pen.strokeStyle = dark ? '#555' : '#ccc'; pen.beginPath();
  for (let i = 0; i < 64; i++) {
    const a = i * Math.PI / 32, b = (i + 1) * Math.PI / 32;
    line([Math.cos(a), Math.sin(a), 0], [Math.cos(b), Math.sin(b), 0]);
  }
  pen.stroke();
  data.points.forEach((p, i) => {
    const q = seen(p); pen.fillStyle = data.colours[i]; pen.fillRect(q[0] - ratio, q[1] - ratio, 2 * ratio, 2 * ratio);
  });
  data.cameras.forEach((c, i) => {
    pen.strokeStyle = i === chosen ? '#ff2878' : dark ? '#8bf' : '#25c'; pen.lineWidth = (i === chosen ? 3 : 1) * ratio;
    pen.beginPath();
    for (let k = 0; k < 4; k++) { line(c[0], c[k + 1]); line(c[k + 1], c[(k + 1) % 4 + 1]); }
    pen.stroke();
  });
  [['#d33', [1, 0, 0], 'x'], ['#3a3', [0, 1, 0], 'y'], ['#36d', [0, 0, 1], 'z, up']].forEach(axis => {
    pen.strokeStyle = pen.fillStyle = axis[0]; pen.lineWidth = 2 * ratio; pen.beginPath();
    line([0, 0, 0], axis[1]); pen.stroke(); pen.font = 12 * ratio + 'px sans-serif';
    const q = seen(axis[1]); pen.fillText(axis[2], q[0] + 4 * ratio, q[1]);
  });
}
let held = null, moved = 0;
canvas.onpointerdown = e => { held = [e.clientX, e.clientY]; moved = 0; canvas.setPointerCapture(e.pointerId); };
canvas.onpointermove = e => {
  if (!held) return;
  const dx = e.clientX - held[0], dy = e.clientY - held[1]; held = [e.clientX, e.clientY];
  moved += Math.abs(dx) + Math.abs(dy); azimuth -= dx / 150;
  elevation = Math.max(-1.57, Math.min(1.57, elevation + dy / 150)); draw();
};
canvas.onpointerup = e => {
  held = null; if (moved > 4) return;
  const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
  let best = 20 * ratio;
  data.cameras.forEach((c, i) => {
    const q = seen(c[0]), far = Math.hypot(q[0] - (e.clientX - box.left) * ratio, q[1] - (e.clientY - box.top) * ratio);
    if (far < best) { best = far; chosen = i; }
  });
  if (best < 20 * ratio) location.hash = 'view' + chosen;
  draw();
};
canvas.addEventListener('wheel', e => {
  e.preventDefault(); zoom = Math.max(0.2, Math.min(20, zoom * Math.exp(-e.deltaY / 500))); draw();
}, { passive: false });
addEventListener('resize', draw); draw();
"""


@dataclass(frozen=True)
class Pictures:
    """What the page shows.

    Attributes:
        images: uint8 [height, width, 4] per placed photograph, small: its own colours everywhere, and the mask.
        cameras: theirs, in the unit ball.
        points: float64 [points, 3] in the same world.
        colours: uint8 [points, 3].
    """

    images: Sequence[np.ndarray]
    cameras: Cameras
    points: np.ndarray
    colours: np.ndarray


def capture_page(title: str, quality: Quality, warnings: Sequence[str], notes: Sequence[str], shown: Pictures) -> bytes:
    """The whole file."""
    body = [
        f"<h1>{html.escape(title)}</h1>",
        f"<p class=note>{len(quality.names)} of {quality.num_photographs} photographs placed. "
        f"{html.escape(' '.join(notes))}</p>",
        _warnings(warnings),
        "<h2>Cameras and points</h2><canvas id=world></canvas><p class=note>Drag to turn, wheel to zoom, click a "
        "camera to see its photograph. The ring is the unit circle on the ground plane through the middle: z "
        "must point up, and the points must look like the object.</p>",
        f"<script id=cameras type='application/json'>{_world(shown)}</script>",
        "<h2>Masks</h2><p class=note>What lies inside the line is taken for the object.</p>",
        _photographs(quality, shown),
        _numbers(quality),
    ]
    return web_page(title, "".join(body), _PAGE_STYLE, _SCRIPT)


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return "<p class=good>Nothing stands out. Look at the cameras and outlines below, then go on.</p>"
    items = "".join(f"<li>{html.escape(text)}</li>" for text in warnings)
    return f"<h2>Look at this first</h2><ul class=warnings>{items}</ul>"


def _world(shown: Pictures) -> str:
    chosen = np.random.default_rng(0).permutation(len(shown.points))[:_MAX_POINTS]
    reach = float(np.linalg.norm(shown.cameras.positions, axis=-1).max())
    near = chosen[np.linalg.norm(shown.points[chosen], axis=-1) < 2 * reach]
    content = {
        "reach": round(reach, 4),
        "points": np.round(shown.points[near], 4).tolist(),
        "colours": ["#" + bytes(colour.tolist()).hex() for colour in shown.colours[near]],
        "cameras": np.round(_frusta(shown.cameras, 0.08 * reach), 4).tolist(),
    }
    return json.dumps(content, separators=(",", ":"))


def _frusta(cameras: Cameras, length: float) -> np.ndarray:
    """float64 [views, 5, 3]: the centre and the four corners of the image at a distance of `length`."""
    fx, fy, cx, cy = cameras.intrinsics.T[..., None]
    x = np.array([0, cameras.width, cameras.width, 0])
    y = np.array([0, 0, cameras.height, cameras.height])
    corners = np.stack([(x - cx) / fx, -(y - cy) / fy, -np.ones((len(cameras), 4))], -1) * length
    turned = np.einsum("vij,vcj->vci", cameras.world_from_camera[:, :3, :3], corners)
    centre = cameras.positions[:, None]
    return np.concatenate([centre, centre + turned], 1)


def outlined(image: np.ndarray) -> Image.Image:
    """`image`, uint8 [height, width, 4] with untouched colours: a line around what its alpha holds, the rest paler."""
    inside = image[..., 3] > 127
    rim = inside & ~ndimage.binary_erosion(inside, np.ones((3, 3)), border_value=1)
    pale = np.round(255 - _PALE * (255 - image[..., :3].astype(np.float32))).astype(np.uint8)
    shown = np.where(inside[..., None], image[..., :3], pale)
    shown[rim] = _OUTLINE
    return Image.fromarray(shown)


def _photographs(quality: Quality, shown: Pictures) -> str:
    figures = "".join(
        f"<figure id=view{view}><img loading=lazy src='{small_url(outlined(image))}' alt='{html.escape(name)}'>"
        f"<figcaption>{html.escape(name)}</figcaption></figure>"
        for view, (name, image) in enumerate(zip(quality.names, shown.images, strict=True))
    )
    return f"<div class=row>{figures}</div>"


def _numbers(quality: Quality) -> str:
    head = "<tr><th>photograph</th><th>points</th><th>error, pixels</th><th>azimuth</th><th>elevation</th></tr>"
    rows = [
        f"<tr><td><a href='#view{view}'>{html.escape(name)}</a></td><td>{quality.num_points[view]}</td>"
        f"<td>{quality.errors[view]:.2f}</td><td>{quality.azimuths[view]:.0f}&deg;</td>"
        f"<td>{quality.elevations[view]:.0f}&deg;</td></tr>"
        for view, name in enumerate(quality.names)
    ]
    rows += [f"<tr><td>{html.escape(name)}</td><td colspan=4>not placed</td></tr>" for name in quality.unplaced]
    summary = (
        f"Median error {np.nanmedian(quality.errors):.2f} pixels; focal length {quality.focal:.3f} longest sides; "
        f"widest gap between cameras around the object {largest_gap(quality.azimuths):.0f} degrees."
    )
    return f"<h2>Numbers</h2><p>{summary}</p><table>{head}{''.join(rows)}</table>"
