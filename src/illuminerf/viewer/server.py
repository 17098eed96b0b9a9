"""The browser's side of the viewer: controls, overlays, and one rendering thread per open page."""

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.data.capture import load_capture
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import to_uint8
from illuminerf.scene.views import Views
from illuminerf.scene.web_page import evenly_spread
from illuminerf.viewer.finished_run import find_run
from illuminerf.viewer.refinement import Speed, refined
from illuminerf.viewer.renderer import RELIT, Look, Picture, ViewRenderer
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say

_FRUSTUM_SCALE, _THUMBNAIL, _MAX_FRUSTUMS = 0.12, 64, 60
_LARGEST_EXACT = 200
_MESH_COLOUR = (150, 160, 175)
_FIRST_FOV = 0.7
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
_PANEL_LABEL = "Open IllumiNeRF"


def view_command(run: Path, host: str, port: int, size: int, device: str) -> None:
    """Serve the run until Ctrl-C."""
    found = find_run(run)
    if not 64 <= size <= 2048 or not 0 <= port < 65536:
        raise UserError("size or port is out of range", got=f"{size} and {port}", wanted="64 to 2048, 0 to 65535")
    viewer = Viewer(ViewRenderer(found, device), host, port, size)
    if found.unfinished:
        say(f"not finished, so not shown: {', '.join(found.unfinished)}")
    address = f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{viewer.port}"
    say(f"open {address} in a browser; Ctrl-C ends the viewer")
    if host == "127.0.0.1":
        say(f"from another machine: ssh -L {viewer.port}:localhost:{viewer.port} THIS_MACHINE, then the same address")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        say("the viewer has ended")
    finally:
        viewer.stop()


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise UserError("the viewer needs viser", got=str(error), fix="pip install 'illuminerf[viewer]'") from error
    return viser


class Viewer:
    """A web server that shows a run.

    Args:
        renderer: of the run.
        host: address to listen at.
        port: 0 lets the system choose; a busy one is passed over.
        size: longest side of the finest picture, in pixels, to begin with.
    """

    def __init__(self, renderer: ViewRenderer, host: str, port: int, size: int) -> None:
        self.renderer, self._views = renderer, load_capture(renderer.run.capture).views
        self._lock, self._speed, self._pages = threading.Lock(), Speed.unknown(), dict[int, _Page]()
        self._server = _viser().ViserServer(host=host, port=port, label=_PANEL_LABEL, verbose=False)
        self.port: int = self._server.get_port()
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._server.initial_camera.position = tuple(self._views.cameras.positions[0])
        self._server.initial_camera.look_at = (0.0, 0.0, 0.0)
        self._server.initial_camera.fov = _FIRST_FOV
        self._add_controls(size)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(lambda client: self._pages.pop(client.client_id).close())

    def stop(self) -> None:
        """Close every page and the server."""
        for page in list(self._pages.values()):
            page.close()
        self._server.stop()

    @property
    def look(self) -> Look:
        """What the controls say."""
        return Look(self._light.value, self._mode.value, float(self._latent.value))

    @property
    def size(self) -> int:
        """Longest side of the finest picture."""
        return int(self._size.value)

    def _add_controls(self, size: int) -> None:
        gui, lights = self._server.gui, self.renderer.lights
        self._light = gui.add_dropdown("Light", lights, initial_value=lights[0])
        self._mode = gui.add_dropdown("Show", self.renderer.modes(lights[0]), initial_value=RELIT)
        hint = "0 is the zero code, n that of the n-th relit sample; in between codes are blended"
        highest = max(self.renderer.num_latents(lights[0]), 1)
        self._latent = gui.add_slider("Latent", 0.0, float(highest), 0.05, 0.0, hint=hint)
        self._size = gui.add_slider("Finest side", 64, 2048, 32, size, hint="Pixels of the picture at rest")
        self._cameras = gui.add_checkbox("Photographs", False, hint="Click one to look from its side")
        self._mesh = gui.add_checkbox("Mesh", False)
        self._light.on_update(self._changed_light)
        for control in (self._mode, self._latent, self._size):
            control.on_update(self._changed)
        self._cameras.on_update(self._changed_overlays)
        self._mesh.on_update(self._changed_overlays)
        self._frustums: list[Any] = []
        self._surface: Any = None

    def _changed(self, _: Any) -> None:
        for page in list(self._pages.values()):
            page.ask()

    def _changed_light(self, event: Any) -> None:
        light = self._light.value
        modes = self.renderer.modes(light)
        if self._mode.value not in modes:
            self._mode.value = RELIT
        self._mode.options = modes
        with self._lock:  # may load a field
            number = self.renderer.num_latents(light)
        self._latent.disabled = number == 0
        self._latent.value = 0.0 if number == 0 else min(self._latent.value, float(number))
        self._latent.max = float(max(number, 1))
        self._changed(event)

    def _changed_overlays(self, event: Any) -> None:
        if self._cameras.value and not self._frustums:
            self._frustums = _add_photographs(self._server, self._views)
        if self._mesh.value and self._surface is None:
            mesh = self.renderer.mesh()
            self._surface = self._server.scene.add_mesh_simple("/mesh", mesh.vertices, mesh.faces, color=_MESH_COLOUR)
        for frustum in self._frustums:
            frustum.visible = self._cameras.value
        if self._surface is not None:
            self._surface.visible = self._mesh.value
        self._changed(event)

    def needs_depth(self) -> bool:
        """Whether overlays have to be hidden behind the object."""
        return bool(self._cameras.value or self._mesh.value)

    def _connected(self, client: Any) -> None:
        self._pages[client.client_id] = _Page(self, client, self._lock, self._speed)


class _Page:
    """One open page: whenever something changes it shows a coarse picture, then finer ones."""

    def __init__(self, viewer: Viewer, client: Any, lock: threading.Lock, speed: Speed) -> None:
        self._viewer, self._client, self._lock, self._speed = viewer, client, lock, speed
        self._version, self._wake, self._is_open = 0, threading.Event(), True
        self._status = client.gui.add_markdown("loading ...")
        client.camera.on_update(lambda _: self.ask())
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()
        self.ask()

    def ask(self) -> None:
        """Something changed."""
        self._version += 1
        self._wake.set()

    def close(self) -> None:
        """The page is gone."""
        self._is_open = False
        self.ask()

    def _work(self) -> None:
        while self._is_open:
            self._wake.wait()
            self._wake.clear()
            version = self._version

            def is_stale(version: int = version) -> bool:
                return version != self._version or not self._is_open

            try:
                with self._lock:
                    for picture, seconds in self._pictures(is_stale):
                        self._show(picture, seconds)
            except UserError as error:
                self._status.content = f"**{error}**"

    def _pictures(self, is_stale: Any) -> Any:
        camera = self._client.camera
        if not camera.image_width or not camera.image_height:
            return iter(())
        rotation = _viser().transforms.SO3(camera.wxyz).as_matrix()
        position, fov, shape = camera.position, camera.fov, (camera.image_height, camera.image_width)

        def sized(side: int) -> Cameras:
            return page_camera(rotation, position, fov, shape, side)

        viewer = self._viewer
        return refined(viewer.renderer, sized, viewer.look, viewer.size, self._speed, is_stale)

    def _show(self, picture: Picture, seconds: float) -> None:
        height, width = picture.depth.shape
        depth = picture.depth if self._viewer.needs_depth() else None
        kind: Any = "png" if max(height, width) <= _LARGEST_EXACT else "jpeg"  # enlarged, a JPEG's blocks show
        self._client.scene.set_background_image(to_uint8(picture.srgb), format=kind, jpeg_quality=92, depth=depth)
        self._status.content = f"{width} x {height}, {seconds:.2f} s"


def page_camera(
    rotation: np.ndarray, position: np.ndarray, fov: float, shape: tuple[int, int], longest_side: int
) -> Cameras:
    """The camera of a page.

    Args:
        rotation: [3, 3], world from camera with OpenCV's axes.
        fov: vertical, in radians.
        shape: height and width of the page, whose proportions the picture gets.
    """
    scale = longest_side / max(shape)
    height, width = (max(1, round(pixels * scale)) for pixels in shape)
    pose = np.eye(4)
    # orthonormal to the last digit, which the browser's numbers are not
    left, _, right = np.linalg.svd(rotation @ _OPENGL_FROM_OPENCV)
    pose[:3, :3], pose[:3, 3] = left @ right, position
    focal = 0.5 * height / np.tan(0.5 * fov)
    focal_x = focal * (shape[0] / shape[1]) * (width / height)  # rounding must not shift what is seen
    return Cameras(pose[None], np.array([[focal_x, focal, width / 2, height / 2]]), height, width)


def _add_photographs(server: Any, views: Views) -> list[Any]:
    """A frustum with a small copy of each photograph; a click moves the page's camera there."""
    handles, cameras = [], views.cameras
    step = max(1, max(cameras.height, cameras.width) // _THUMBNAIL)
    for view in evenly_spread(range(len(views)), _MAX_FRUSTUMS):
        pose = cameras.world_from_camera[view]
        wxyz = _viser().transforms.SO3.from_matrix(pose[:3, :3] @ _OPENGL_FROM_OPENCV).wxyz
        alpha = views.alpha[view][::step, ::step, None]
        small = np.asarray(views.srgb[view][::step, ::step]) * alpha + 1 - alpha
        fov = 2 * np.arctan(0.5 * cameras.height / cameras.intrinsics[view, 1])
        handle = server.scene.add_camera_frustum(
            f"/photographs/{view:03d}", float(fov), cameras.width / cameras.height, scale=_FRUSTUM_SCALE,
            image=to_uint8(small), wxyz=wxyz, position=pose[:3, 3], color=(60, 60, 60),
        )  # fmt: skip
        handle.on_click(lambda event, handle=handle, fov=fov: _look_from(event.client, handle, float(fov)))
        handles.append(handle)
    return handles


def _look_from(client: Any, frustum: Any, fov: float) -> None:
    with client.atomic():
        client.camera.position, client.camera.wxyz, client.camera.fov = frustum.position, frustum.wxyz, fov
        client.camera.look_at = (0.0, 0.0, 0.0)
