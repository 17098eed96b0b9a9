"""What a folder that `illuminerf relight` wrote has to show."""

from dataclasses import dataclass
from pathlib import Path

from illuminerf.workflow.checksums import is_artefact, verify_once
from illuminerf.workflow.errors import UserError

_AGAIN = "run the same relight command again; it goes on where it stopped"


@dataclass(frozen=True)
class FinishedRun:
    """Artefacts of a run, those that are finished.

    Attributes:
        path: the run's folder.
        capture, geometry: artefacts all lights share.
        lights: by name, the folder of each light whose latent NeRF is fitted.
        unfinished: names of the other lights.
    """

    path: Path
    capture: Path
    geometry: Path
    lights: dict[str, Path]
    unfinished: tuple[str, ...]


def find_run(folder: Path) -> FinishedRun:
    """The run in `folder`.

    Raises:
        UserError: it does not exist, is no run, has nothing finished to show, or is damaged.
    """
    if not folder.is_dir():
        raise UserError(f"the run {folder} does not exist", wanted="a folder that 'illuminerf relight' wrote")
    if not (folder / "capture").is_dir() or not (folder / "lights").is_dir() and not (folder / "geometry").is_dir():
        inside = sorted(path.parent.name for path in folder.glob("*/lights"))
        raise UserError(
            f"{folder} is no run",
            got=f"a folder of runs: {', '.join(inside)}" if inside else "no capture/, geometry/ and lights/",
            wanted="the --out of 'illuminerf relight' or 'illuminerf demo'",
            fix=f"name {folder / inside[0]}" if inside else "check the path",
        )
    for stage in ("capture", "geometry"):
        if not (folder / stage / "DONE").is_file():
            raise UserError(f"the run {folder} is unfinished", got=f"no finished {stage}", fix=_AGAIN)
    found = {path.name: path for path in sorted((folder / "lights").glob("*")) if path.is_dir()}
    lights = {name: path for name, path in found.items() if (path / "latent_nerf" / "DONE").is_file()}
    if not lights:
        raise UserError(f"the run {folder} is unfinished", got="no light with a finished latent_nerf", fix=_AGAIN)
    for artefact in (folder / "capture", folder / "geometry", *(path / "latent_nerf" for path in lights.values())):
        if is_artefact(artefact):
            verify_once(artefact)
    unfinished = tuple(name for name in found if name not in lights)
    return FinishedRun(folder, folder / "capture", folder / "geometry", lights, unfinished)
