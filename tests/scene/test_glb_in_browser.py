"""Relit meshes as programs show them: three.js in a headless Chromium, and the checker of the glTF standard.

Both come from npm and are not part of this repository: `npm install three gltf-validator` anywhere, and name its
node_modules in ILLUMINERF_NODE_MODULES.
"""

import functools
import http.server
import json
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from illuminerf.scene.coloured_meshes import save_coloured_glb, save_textured_glb
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.scene.triangle_atlas import TriangleAtlas
from tests.viewer.browser import FOUND, Browser, wait_for

MODULES = Path(os.environ.get("ILLUMINERF_NODE_MODULES", "/nowhere"))
SIZE = 128
PAGE = """<!doctype html><link rel=icon href="data:,"><style>body { margin: 0 }</style>
<script type=importmap>{"imports": {"three": "./three/build/three.module.js"}}</script>
<script type=module>
import * as THREE from 'three';
import { GLTFLoader } from './three/examples/jsm/loaders/GLTFLoader.js';
const renderer = new THREE.WebGLRenderer(), scene = new THREE.Scene();
renderer.setSize(SIZE, SIZE); renderer.setClearColor(0xffffff); document.body.append(renderer.domElement);
const [file, x, y, z] = location.hash.slice(1).split(',');
const camera = new THREE.PerspectiveCamera(50, 1, 0.1, 10);
camera.position.set(+x, +y, +z); camera.lookAt(0, 0, 0);
new GLTFLoader().load(file, found => { scene.add(found.scene); renderer.render(scene, camera); window.shown = true; });
</script>""".replace("SIZE", str(SIZE))
CHECK = """
const [modules, ...files] = process.argv.slice(1), validator = require(modules + '/gltf-validator');
const check = file => validator.validateBytes(new Uint8Array(require('fs').readFileSync(file)));
Promise.all(files.map(check)).then(found => console.log(JSON.stringify(found.map(report => report.issues))));
"""


def colour_at(positions: np.ndarray) -> np.ndarray:
    """sRGB that differs from side to side."""
    return 0.5 + 0.4 * positions


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball, its colours at its vertices, in a texture, or absent."""
    path = tmp_path_factory.mktemp("glb")
    mesh = sphere_mesh(4)
    coloured = TriangleMesh(mesh.vertices, mesh.faces, mesh.vertex_normals, colour_at(mesh.vertices))
    save_coloured_glb(path / "coloured.glb", coloured)
    mesh.save_glb(path / "plain.glb")
    coarse = sphere_mesh(3)
    atlas = TriangleAtlas(len(coarse.faces), 3)
    face, barycentric = atlas.texels_of_cells(np.arange(atlas.num_cells))
    places = np.einsum("ctk,ctkx->ctx", barycentric, coarse.vertices[coarse.faces][face])
    save_textured_glb(path / "textured.glb", coarse, atlas, atlas.picture(colour_at(places)).astype(np.float32))
    return path


@pytest.fixture
def page(folder: Path) -> Iterator[tuple[Browser, str]]:
    if FOUND is None:
        pytest.skip("there is no Chromium")
    if not (MODULES / "three").is_dir():
        pytest.skip("ILLUMINERF_NODE_MODULES names no folder with three")
    pytest.importorskip("websockets", reason="needs websockets")
    (folder / "index.html").write_text(PAGE)
    if not (folder / "three").exists():
        (folder / "three").symlink_to((MODULES / "three").resolve())
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser = Browser(SIZE, SIZE)
    yield browser, f"http://127.0.0.1:{server.server_port}"
    browser.close()
    server.shutdown()


def shown(page: tuple[Browser, str], name: str, world: np.ndarray) -> np.ndarray:
    """The colour in the middle of the picture that a camera on the side `world` of our z-up world takes, in [0, 1]."""
    browser, address = page
    x, y, z = 2.5 * world
    browser.call("Emulation.setDeviceMetricsOverride", width=SIZE, height=SIZE, deviceScaleFactor=1, mobile=False)
    browser.call("Page.navigate", url="about:blank")
    browser.call("Page.navigate", url=f"{address}/index.html#{name},{x},{z},{-y}")
    wait_for(lambda: browser.evaluate("window.shown"), 60)
    return browser.screenshot()[SIZE // 2, SIZE // 2] / 255


@pytest.mark.parametrize("name", ["coloured.glb", "textured.glb"])
def test_three_js_shows_every_side_in_its_own_colour(page: tuple[Browser, str], name: str) -> None:
    sides = np.array([[1, 0, 0], [0, 1, 0], [0, 0.6, 0.8]])
    found = np.stack([shown(page, name, side) for side in sides])
    np.testing.assert_allclose(found, colour_at(sides), atol=2.5 / 255)
    assert np.abs(found - colour_at(sides[::-1])).max() > 0.2, "wrong axes must show"
    assert np.abs(found - colour_at(sides) ** 2.2).max() > 0.2, "and so must colours decoded once too often"
    assert page[0].errors == []


def test_the_standards_own_checker_finds_nothing(folder: Path) -> None:
    if not (MODULES / "gltf-validator").is_dir() or shutil.which("node") is None:
        pytest.skip("there is no node, or ILLUMINERF_NODE_MODULES names no folder with gltf-validator")
    (folder / "broken.glb").write_bytes((folder / "coloured.glb").read_bytes()[:-4])
    files = [str(folder / f"{name}.glb") for name in ("coloured", "textured", "plain", "broken")]
    said = subprocess.run(["node", "-e", CHECK, str(MODULES), *files], capture_output=True, text=True, check=True)
    coloured, textured, plain, broken = json.loads(said.stdout)
    for issues in (coloured, textured, plain):
        assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]
    assert coloured["messages"] == [] and broken["numErrors"] > 0
