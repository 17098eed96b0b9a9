"""What a finished run left behind, by name: the layout of the folder that `pipeline.relight` writes."""

from dataclasses import dataclass
from pathlib import Path

from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class RelitObject:
    """The object under one light. Files exist once the run is finished."""

    folder: Path
    """lights/<name> of the run."""

    @property
    def name(self) -> str:
        """The light's name."""
        return self.folder.name

    @property
    def video(self) -> Path:
        """One turn around the object, MP4 on white."""
        return self.folder / "turntable.mp4"

    @property
    def gif(self) -> Path:
        """The same as a GIF, where it was asked for."""
        return self.folder / "turntable.gif"

    @property
    def mesh(self) -> Path:
        """The object with its relit colours: binary glTF, y-up, unlit, a colour per vertex."""
        return self.folder / "relit_mesh" / "relit.glb"

    @property
    def ply(self) -> Path:
        """The same as PLY, z-up, a colour per vertex."""
        return self.folder / "relit_mesh" / "relit.ply"

    @property
    def latent_nerf(self) -> Path:
        """The field that views are rendered from."""
        return self.folder / "latent_nerf"

    @property
    def frames(self) -> list[Path]:
        """PNGs of the turntable, sRGB with straight alpha."""
        return sorted((self.folder / "turntable" / "images").glob("*.png"))

    @property
    def radiance(self) -> list[Path]:
        """EXRs of the turntable: linear radiance, premultiplied, with alpha."""
        return sorted((self.folder / "turntable" / "linear").glob("*.exr"))

    @property
    def cues(self) -> list[Path]:
        """EXRs of the radiance cues, one per photograph."""
        return sorted((self.folder / "cues" / "cues").glob("*.exr"))

    @property
    def samples(self) -> list[Path]:
        """PNGs <photograph>_<sample> of the relighting diffusion model."""
        return sorted((self.folder / "relit" / "samples").glob("*.png"))


@dataclass(frozen=True)
class RunFolder:
    """A run: one object under one light or several."""

    folder: Path
    """What was given as `out`."""

    def __fspath__(self) -> str:
        return str(self.folder)

    @property
    def relit_mesh(self) -> Path:
        """The object with the first light's colours: binary glTF, y-up, unlit, a colour per vertex."""
        return self.folder / "relit.glb"

    @property
    def report(self) -> Path:
        """One HTML page with everything to look at."""
        return self.folder / "report.html"

    @property
    def mesh(self) -> Path:
        """The geometry without colours: binary glTF, y-up."""
        return self.folder / "mesh.glb"

    @property
    def video(self) -> Path:
        """The first light's turntable."""
        return self.folder / "turntable.mp4"

    @property
    def capture(self) -> Path:
        """The imported photographs and cameras."""
        return self.folder / "capture"

    @property
    def photographs(self) -> list[Path]:
        """PNGs of the photographs as they were used, sRGB with straight alpha."""
        return sorted((self.capture / "images").glob("*.png"))

    @property
    def lights(self) -> dict[str, RelitObject]:
        """The object under each light, by the light's name."""
        folders = sorted(path for path in (self.folder / "lights").glob("*") if path.is_dir())
        return {path.name: RelitObject(path) for path in folders}

    def light(self, name: str | None = None) -> RelitObject:
        """The object under one light; None where there is only one.

        Raises:
            UserError: there is no such light or no run, or there are several and none was named.
        """
        lights = self.lights
        if not lights:
            raise UserError(
                f"{self.folder} is not a run", wanted="the --out of illuminerf relight", fix="check the path"
            )
        if name is None and len(lights) == 1:
            return next(iter(lights.values()))
        if name not in lights:
            raise UserError(
                "which light is meant?" if name is None else "this run has no such light",
                got=name or "none",
                wanted=" or ".join(lights),
                fix="name it with --light",
            )
        return lights[name]
