"""JOBS.yaml -> jobs, with errors that name the line and the key.

    out: runs/shop                  folder or fsspec URL
    defaults:                       of every job; all keys of a job but name, capture and out
      preset: embedded
      lights: [studio, evening]
    jobs:
      - capture: photos/mug         folder or fsspec URL; all other keys are optional
      - capture: photos/shoe
        name: left_shoe             else the capture's name
        lights: [lights/sunset.exr]
        samples: 8

Relative paths start at the file's own folder.
"""

import dataclasses
import re
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from illuminerf.diffusion.pretrained import check_model
from illuminerf.presets import Preset, customised
from illuminerf.scene.named_lights import find_light
from illuminerf.workflow.config import changed, coerced
from illuminerf.workflow.errors import UserError

_NAME = re.compile(r"[\w.-]*\w")


@dataclass(frozen=True)
class Job:
    """One capture under one light or several: what `illuminerf relight` would be called with."""

    name: str
    capture: str
    """Path or fsspec URL."""
    lights: tuple[str, ...]
    """Paths, fsspec URLs or names of bundled lights."""
    out: str
    """Folder or fsspec URL of the run."""
    preset: Preset
    mesh: str = ""
    """Path or fsspec URL of a mesh that takes the place of estimated geometry; "": none."""
    ldr_peak: float = 1.0
    """Radiance that the white of a PNG or JPEG light stands for."""

    @property
    def light_names(self) -> tuple[str, ...]:
        return tuple(Path(light).stem for light in self.lights)

    def light(self, name: str) -> str:
        """The light of that name."""
        return self.lights[self.light_names.index(name)]


@dataclass(frozen=True)
class JobFile:
    """A whole JOBS.yaml."""

    out: str
    jobs: tuple[Job, ...]


@dataclass(frozen=True)
class _Entry:
    """The keys of a job as they stand in the file; None: not there."""

    name: str | None = None
    capture: str | None = None
    out: str | None = None
    lights: tuple[str, ...] | None = None
    preset: str | None = None
    samples: int | None = None
    size: int | None = None
    seed: int | None = None
    device: str | None = None
    rotate: float | None = None
    exposure: float | None = None
    background: str | None = None
    model: str | None = None
    mesh: str | None = None
    ldr_peak: float | None = None
    settings: dict[str, Any] | None = None


_ONE_JOBS_OWN = ("name", "capture", "out")


def is_url(place: str) -> bool:
    """Whether a place is an fsspec URL rather than a path."""
    return "://" in place


def read_jobs(path: Path) -> JobFile:
    """Read and check a JOBS.yaml: everything that can be found wrong before work starts is.

    Raises:
        UserError: the file is missing or no such YAML, or a key, a value, a capture, a light or a model is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read", got=str(error), wanted="a YAML file of jobs") from error
    loader = yaml.SafeLoader(text)
    try:
        root = loader.get_single_node()
        return _Reader(path, lambda node: loader.construct_object(node, deep=True)).file(root)
    except (yaml.YAMLError, RecursionError) as error:
        raise UserError(f"{path} is not valid YAML", got=" ".join(str(error).split())) from error
    finally:
        loader.dispose()


@dataclass(frozen=True)
class _Reader:
    path: Path
    construct: Callable[[yaml.Node], Any]

    def file(self, root: yaml.Node | None) -> JobFile:
        if root is None:
            raise UserError(f"{self.path} is empty", wanted="the keys out and jobs")
        parts = dict(self.pairs(root, ("out", "defaults", "jobs"), "the file"))
        for key in ("out", "jobs"):
            if key not in parts:
                raise self.wrong(root, f"the key '{key}' is missing")
        out = self.place(self.value(parts["out"], "out", str))
        shared = tuple(name for name in _names() if name not in _ONE_JOBS_OWN)
        defaults = self.entry(parts["defaults"], shared, "defaults") if "defaults" in parts else _Entry()
        if not isinstance(parts["jobs"], yaml.SequenceNode) or not parts["jobs"].value:
            raise self.wrong(parts["jobs"], "'jobs' must be a list with at least one job")
        jobs: list[Job] = []
        for node in parts["jobs"].value:
            jobs.append(self.job(node, defaults, out, jobs))
        return JobFile(out, tuple(jobs))

    def job(self, node: yaml.Node, defaults: _Entry, out: str, before: list[Job]) -> Job:
        entry = self.entry(node, _names(), "a job")
        given = {name: value for name, value in vars(entry).items() if value is not None}
        if entry.settings and defaults.settings:
            given["settings"] = defaults.settings | entry.settings
        entry = dataclasses.replace(defaults, **given)
        if not entry.capture:
            raise self.wrong(node, "a job has no 'capture'")
        name = entry.name or Path(entry.capture).name
        with_line = f"job '{name}'"
        if not _NAME.fullmatch(name):
            raise self.wrong(node, f"{with_line} has no usable name", wanted="letters, digits, _, - and .")
        try:
            job = Job(
                name,
                self.place(entry.capture),
                tuple(self.light(light) for light in entry.lights or ()),
                self.place(entry.out) if entry.out else f"{out.rstrip('/')}/{name}",
                _preset(dataclasses.replace(entry, model=entry.model and self.model(entry.model))),
                self.place(entry.mesh) if entry.mesh else "",
                1.0 if entry.ldr_peak is None else entry.ldr_peak,
            )
            _check(job, before)
        except UserError as error:
            raise self.wrong(
                node, f"{with_line}: {error.what}", got=error.got, wanted=error.wanted, fix=error.fix
            ) from error
        return job

    def entry(self, node: yaml.Node, keys: tuple[str, ...], what: str) -> _Entry:
        hints = typing.get_type_hints(_Entry)
        return _Entry(**{key: self.value(value, key, hints[key]) for key, value in self.pairs(node, keys, what)})

    def pairs(self, node: yaml.Node, keys: tuple[str, ...], what: str) -> Iterator[tuple[str, yaml.Node]]:
        """(key, value) of a mapping whose keys are all known and there once."""
        if not isinstance(node, yaml.MappingNode):
            raise self.wrong(node, f"{what} must have keys", got=node.id, wanted=", ".join(keys))
        seen = set()
        for key_node, value in node.value:
            key = self.construct(key_node)
            if key not in keys:
                raise self.wrong(key_node, f"{what} has no key '{key}'", wanted=", ".join(keys))
            if key in seen:
                raise self.wrong(key_node, f"the key '{key}' is there twice")
            seen.add(key)
            yield key, value

    def value(self, node: yaml.Node, key: str, hint: Any) -> Any:
        try:
            return coerced(f"'{key}'", hint, self.construct(node))
        except UserError as error:
            raise self.wrong(node, error.what, got=error.got, wanted=error.wanted) from error

    def place(self, place: str) -> str:
        return place if is_url(place) else str((self.path.parent / Path(place).expanduser()).absolute())

    def light(self, light: str) -> str:
        """A file's path, or the name as it stands."""
        return placed if is_url(placed := self.place(light)) or Path(placed).is_file() else light

    def model(self, model: str) -> str:
        """A folder's path, or the name as it stands."""
        return placed if Path(placed := self.place(model)).is_dir() else model

    def wrong(self, node: yaml.Node, what: str, **more: str) -> UserError:
        return UserError(f"{self.path}, line {node.start_mark.line + 1}: {what}", **more)


def _names() -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(_Entry))


def _preset(entry: _Entry) -> Preset:
    preset = customised(
        entry.preset or "embedded",
        samples=entry.samples,
        size=entry.size,
        seed=entry.seed or 0,
        device=entry.device or "auto",
        rotate_degrees=entry.rotate or 0.0,
        exposure_stops=entry.exposure or 0.0,
        background=entry.background,
        model=entry.model,
    )
    for name, value in (entry.settings or {}).items():
        preset = changed(preset, name, value)
    return preset


def _check(job: Job, before: list[Job]) -> None:
    """Find what would fail later."""
    if not job.lights:
        raise UserError("no light was given", wanted="a list of lights", fix="set 'lights' here or in 'defaults'")
    if len(set(job.light_names)) < len(job.lights):
        raise UserError("two lights have the same name", got=", ".join(job.light_names), fix="rename one of the files")
    for other in before:
        if job.name == other.name:
            raise UserError("two jobs have this name", fix="set 'name'")
        if job.out == other.out:
            raise UserError(f"its 'out' is that of job '{other.name}'", got=job.out)
    for what, place in (("capture", job.capture), ("mesh", job.mesh)):
        if place and not is_url(place) and not Path(place).exists():
            raise UserError(f"the {what} does not exist", got=place, fix="check the path")
    for light in job.lights:
        if not is_url(light):
            find_light(Path(light), job.ldr_peak)
    check_model(job.preset.relighting_model)
