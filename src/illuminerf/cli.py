"""The command line: one subcommand per stage, plus `relight` and `demo` that run them all."""

import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import field, make_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro
from rich.markup import escape

from illuminerf import (
    ablation,
    benchmark,
    datasets,
    demo,
    films,
    geometry_benchmark,
    lights,
    models,
    orb_illumination_study,
    pipeline,
    rotating_light,
    stanford_orb,
)
from illuminerf.batch.command import batch_command
from illuminerf.data.objaverse_download import download_objaverse
from illuminerf.data.object_collection import read_ids
from illuminerf.presets import PRESETS, Preset, customised
from illuminerf.run_folder import RunFolder
from illuminerf.scene.example_assets import write_example_assets
from illuminerf.stages import (
    bake_relit_mesh,
    estimate_cameras,
    estimate_geometry,
    estimate_illumination,
    evaluate_relighting,
    fit_latent_nerf,
    fit_materials,
    import_capture,
    preview_training_pairs,
    relight_views,
    render_demo_capture,
    render_materials,
    render_novel_views,
    render_radiance_cues,
    render_training_pairs,
    train_relighting_model,
    use_mesh,
)
from illuminerf.workflow.atomic import explained_errors
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say
from illuminerf.workflow.task_pool import Execution

PositionalPath = Annotated[Path, tyro.conf.Positional]
_DEFAULT_PREVIEW = preview_training_pairs.Config()
_ALL_CORES = Execution()
_ONE_TURN = rotating_light.Config()


def relight_command(
    capture: PositionalPath,
    out: Path,
    light: tyro.conf.UseAppendAction[tuple[Path, ...]],
    preset: str = "embedded",
    samples: int | None = None,
    size: int | None = None,
    seed: int = 0,
    device: str = "auto",
    rotate: float = 0.0,
    exposure: float = 0.0,
    background: str | None = None,
    model: str | None = None,
    mesh: Path | None = None,
    ldr_peak: float = 1.0,
    gif: bool = False,
) -> None:
    """Relight a capture: every stage of the method, from photographs to turntable, mesh and report.

    Args:
        capture: Folder of posed photographs (transforms.json, a TensoIR scene, or images/ + cameras.json).
        out: Folder of the run; run the same command again to go on after an interruption.
        light: Equirectangular .exr or .hdr map, or a name of `illuminerf lights list`; repeat for several lights,
            geometry is estimated once.
        preset: Settings of all stages: see `illuminerf presets`.
        samples: Samples per photograph (S in the paper).
        size: Longest side of the photographs in pixels; larger ones are averaged down.
        seed: Of every random stream.
        device: auto, cpu or cuda.
        rotate: Turns the light about the vertical axis, in degrees, counter-clockwise seen from above.
        exposure: Stops by which the light is made brighter.
        background: Background to cut away where the photographs have no masks: plain (any even colour), white or black.
        model: Another relighting model than the preset's: a folder, embedded or dilightnet.
        mesh: A .glb, .obj or .ply mesh in the capture's world that takes the place of estimated geometry.
        ldr_peak: Radiance that the white of a PNG or JPEG light stands for; 1 takes it as it is.
        gif: Also write each light's turntable as a GIF.
    """
    settings = customised(
        preset, samples=samples, size=size, seed=seed, device=device, rotate_degrees=rotate, exposure_stops=exposure,
        background=background, model=model,
    )  # fmt: skip
    jobs = [pipeline.LightJob(path, ldr_peak=ldr_peak) for path in light]
    pipeline.relight(capture, jobs, settings, out, mesh)
    for path in light if gif else ():
        films.write_turntable_gif(RunFolder(out).light(path.stem))
    say(f"done: {out / 'report.html'}, {out / 'turntable.mp4'}, {out / 'relit.glb'}")


def render_command(
    run: PositionalPath,
    out: Path,
    light: str | None = None,
    cameras: Path | None = None,
    size: int | None = None,
    views: int = 72,
    gif: bool = False,
    device: str = "auto",
) -> None:
    """Render a finished run along a camera path or a turntable: PNG with alpha, linear EXR, MP4 and GIF.

    Args:
        run: What `illuminerf relight --out` named.
        out: Folder for views/images/*.png, views/linear/*.exr, film.mp4 and film.gif.
        light: Which of the run's lights (the name of its file); not needed where there is one.
        cameras: cameras.json, transforms.json or nerfstudio's camera_path.json, in the world of the photographs' poses.
        size: Longest side of the images in pixels; by default the camera file's own, else the photographs'.
        views: Frames of the turntable where no cameras are given.
        gif: Also write a GIF.
        device: auto, cpu or cuda.
    """
    film = films.render(RunFolder(run), out, light, cameras, size, views, gif, device)
    say(f"done: {film.video}, {len(film.frames)} views in {film.frames[0].parent}")


def rotate_light_command(
    run: PositionalPath,
    out: Path,
    light: str | None = None,
    model: str = "embedded",
    config: Annotated[rotating_light.Config, tyro.conf.arg(name="")] = _ONE_TURN,
) -> None:
    """Film one photograph of a finished run while the light turns about it: rotating.mp4 and .gif.

    Args:
        run: What `illuminerf relight --out` named.
        out: Folder for images/*.png and the films; run the same command again to go on after an interruption.
        light: Which of the run's lights (the name of its file); not needed where there is one.
        model: The relighting model: a folder, embedded or dilightnet.
        config: Which photograph, and how the light turns.
    """
    say(f"done: {rotating_light.film(RunFolder(run), out, light, model, config)}")


def demo_command(out: Path = Path("runs/demo"), device: str = "auto", seed: int = 0) -> None:
    """Relight the capture that ships with the package and score the result.

    Args:
        out: Folder of the run.
        device: auto, cpu or cuda.
        seed: Of every random stream.
    """
    demo.run(out, customised("demo", device=device, seed=seed))


def presets_command() -> None:
    """List the presets: what each is for and what it costs."""
    for preset in PRESETS.values():
        say(f"[bold]{escape(preset.name)}[/bold]: {escape(preset.description)}", markup=True)


def _pairs_command(what: str, default: render_training_pairs.Config) -> Callable[..., None]:
    """A subcommand that renders training pairs, with `default` as the defaults of its options."""

    def command(
        objects: PositionalPath,
        lights: PositionalPath,
        out: str,
        config: Annotated[render_training_pairs.Config, tyro.conf.arg(name="")] = default,
        execution: Annotated[Execution, tyro.conf.arg(name="")] = _ALL_CORES,
    ) -> None:
        render_training_pairs.run(objects, lights, config, out, execution)
        say(f"done: {out}")

    command.__doc__ = f"""{what}

    Args:
        objects: Folder of .glb, .gltf, .obj and .ply files, an Objaverse folder, or a list of Objaverse ids.
        lights: Folder of .exr or .hdr environment maps.
        out: Folder or fsspec URL; run the same command again to go on after an interruption.
        config: What is rendered.
        execution: Where.
    """
    return command


def preview_command(
    pairs: tyro.conf.Positional[str],
    out: Path = Path("pairs.png"),
    config: Annotated[preview_training_pairs.Config, tyro.conf.arg(name="")] = _DEFAULT_PREVIEW,
) -> None:
    """Draw a contact sheet of training pairs: lights, cues, materials, normals, composited materials.

    Args:
        pairs: Folder or fsspec URL that render-training-pairs wrote or is writing.
        out: The .png to write.
        config: What the sheet shows.
    """
    preview_training_pairs.run(pairs, config, out)
    say(f"done: {out}")


def download_objaverse_command(
    ids: PositionalPath, root: PositionalPath, first: int | None = None, processes: int = 4
) -> None:
    """Download objects of Objaverse with the `objaverse` package; what is there is not fetched again.

    Args:
        ids: File of ids: a JSON list, a CSV with a column uid, or one id a line.
        root: Folder that gets hf-objaverse-v1; render-training-pairs takes it as OBJECTS.
        first: Only so many ids from the start of the list.
        processes: Parallel downloads.
    """
    paths = download_objaverse(read_ids(ids)[:first], root, processes)
    say(f"done: {len(paths)} objects in {root}")


def example_assets_command(folder: PositionalPath) -> None:
    """Write a few objects and lights made from formulas, to try render-training-pairs on.

    Args:
        folder: Gets objects/*.glb and lights/*.exr.
    """
    objects, lights = write_example_assets(folder)
    say(f"done: {objects}, {lights}")


def view_command(
    run: PositionalPath, host: str = "127.0.0.1", port: int = 8080, size: int = 512, device: str = "auto"
) -> None:
    """Look at a finished run in the browser: orbit, switch lights, slide through latents, see cues, normals and mesh.

    Args:
        run: What relight or demo wrote.
        host: Address to listen at; 0.0.0.0 lets other machines in, without any password.
        port: The next free one is taken where this is busy.
        size: Longest side of the finest picture in pixels.
        device: auto, cpu or cuda.
    """
    from illuminerf.viewer import server

    server.view_command(run, host, port, size, device)


class StageCall:
    """Parsed arguments of one stage's subcommand."""

    run: ClassVar[Callable[..., Path]]
    inputs: ClassVar[tuple[str, ...]]

    def execute(self) -> None:
        """Run the stage."""
        out: Path = getattr(self, "out")  # noqa: B009
        type(self).run(*(getattr(self, name) for name in self.inputs), getattr(self, "config"), out)  # noqa: B009
        say(f"done: {out}")


def _stage(
    run: Callable[..., Path],
    config: type,
    description: str,
    inputs: dict[str, Any],
    default: Callable[[], Any] | None = None,
) -> type[StageCall]:
    """A subcommand of one stage: its inputs as positional arguments, its config's fields as options (with the values of
    `default`, else the config's own), and --out."""
    fields: list[tuple[str, Any, Any]] = []
    for name, kind in inputs.items():
        is_optional = kind == Path | None
        argument = kind if is_optional else Annotated[kind, tyro.conf.Positional]
        fields.append((name, argument, field(default=None) if is_optional else field()))
    fields.append(("out", Path, field()))
    fields.append(("config", Annotated[config, tyro.conf.arg(name="")], field(default_factory=default or config)))
    call = make_dataclass("Stage", fields, bases=(StageCall,), kw_only=True)
    call.run, call.inputs, call.__doc__ = staticmethod(run), tuple(inputs), description  # type: ignore[attr-defined]
    return call


COMMANDS: dict[str, Callable[..., Any]] = {
    "relight": relight_command,
    "render": render_command,
    "rotate-light": rotate_light_command,
    "demo": demo_command,
    "batch": batch_command,
    "presets": presets_command,
    "view": view_command,
    "capture": _stage(
        estimate_cameras.run,
        estimate_cameras.Config,
        "Make a capture from photographs without poses, or from a video: poses, masks, and a page to check them by.",
        {"photographs": Path},
    ),
    "import-capture": _stage(
        import_capture.run,
        import_capture.Config,
        "Read a folder of posed photographs into a capture.",
        {"source": Path},
    ),
    "estimate-geometry": _stage(
        estimate_geometry.run, estimate_geometry.Config, "Fit the surface field to a capture.", {"capture": Path}
    ),
    "use-mesh": _stage(
        use_mesh.run,
        use_mesh.Config,
        "Take a mesh in the capture's world for its geometry, in place of estimate-geometry.",
        {"mesh": Path, "capture": Path},
    ),
    "estimate-illumination": _stage(
        estimate_illumination.run,
        estimate_illumination.Config,
        "Estimate the photographs' own light from geometry and photographs, and path trace its diffuse shading.",
        {"geometry": Path, "capture": Path},
    ),
    "render-radiance-cues": _stage(
        render_radiance_cues.run,
        render_radiance_cues.Config,
        "Path trace the geometry with the four cue materials under a light.",
        {"geometry": Path, "capture": Path, "light": Path},
    ),
    "relight-views": _stage(
        relight_views.run,
        relight_views.Config,
        "Draw relit samples of every photograph; the model is a folder, or the word embedded or dilightnet.",
        {"capture": Path, "cues": Path, "model": str, "illumination": Path | None},
    ),
    "fit-latent-nerf": _stage(
        fit_latent_nerf.run,
        fit_latent_nerf.Config,
        "Distil all relit samples into one latent NeRF on the estimated geometry.",
        {"geometry": Path, "capture": Path, "relit": Path},
    ),
    "render-novel-views": _stage(
        render_novel_views.run,
        render_novel_views.Config,
        "Render a latent NeRF (or a geometry's own appearance) from a turntable or given cameras.",
        {"field": Path, "cameras": Path | None},
    ),
    "bake-relit-mesh": _stage(
        bake_relit_mesh.run,
        bake_relit_mesh.Config,
        "Paint the mesh with a latent NeRF's colours: relit.glb (unlit) and relit.ply.",
        {"field": Path, "geometry": Path, "capture": Path},
    ),
    "evaluate-relighting": _stage(
        evaluate_relighting.run,
        evaluate_relighting.Config,
        "Score rendered views against the truth by the TensoIR rule.",
        {"novel_views": Path, "truth": Path},
    ),
    "fit-materials": _stage(
        fit_materials.run,
        fit_materials.Config,
        "Inverse rendering, to compare with: fit materials and the photographs' light on the estimated geometry.",
        {"geometry": Path, "capture": Path, "illumination": Path | None},
    ),
    "render-materials": _stage(
        render_materials.run,
        render_materials.Config,
        "Path trace fitted materials under a light from given cameras.",
        {"materials": Path, "cameras": Path, "light": Path},
    ),
    "render-training-pairs": _pairs_command(
        "Render objects under several lights, with cues: what a relighting model learns from.",
        render_training_pairs.Config(),
    ),
    "render-paper-pairs": _pairs_command(
        "The same as render-training-pairs, with the paper's numbers as defaults (512 x 512, 512 samples per pixel).",
        render_training_pairs.Config.paper(),
    ),
    "train-rdm": _stage(
        train_relighting_model.run,
        train_relighting_model.Config,
        "Train a relighting diffusion model on rendered pairs.",
        {"pairs": str, "heldout": str},
    ),
    "train-paper-rdm": _stage(
        train_relighting_model.run,
        train_relighting_model.Config,
        "Train the paper's control on the frozen base --control.base: train-rdm with the paper's settings.",
        {"pairs": str, "heldout": str},
        train_relighting_model.Config.paper,
    ),
    "evaluate-rdm": benchmark.relighting_model_command,
    "render-demo-capture": _stage(
        render_demo_capture.run, render_demo_capture.Config, "Render the bundled demo capture from its formulas.", {}
    ),
}
GROUPS: dict[str, dict[str, Callable[..., None]]] = {
    "benchmark": {
        "tensoir": benchmark.tensoir_command,
        "stanford-orb": stanford_orb.stanford_orb_command,
        "stanford-orb-illumination": orb_illumination_study.illumination_study_command,
        "ablation": ablation.ablation_command,
        "geometry": geometry_benchmark.geometry_command,
        "report": benchmark.report_command,
    },
    "data": {
        "preview": preview_command,
        "download-objaverse": download_objaverse_command,
        "example-assets": example_assets_command,
        "tensoir-gallery": datasets.tensoir_gallery_command,
        "synthetic-orb": datasets.synthetic_orb_command,
    },
    "lights": {
        "list": lights.list_command,
        "preview": lights.preview_command,
        "convert": lights.convert_command,
    },
    "models": {
        "list": models.list_command,
        "info": models.info_command,
        "download": models.download_command,
        "export": models.export_command,
    },
}


def main(arguments: list[str] | None = None) -> None:
    """Entry point: exit status 0, 2 for what the user can mend, 130 for Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    warnings.showwarning = lambda message, *_: say(f"[yellow]warning:[/yellow] {escape(str(message))}", markup=True)
    try:
        with explained_errors(Path.cwd()):
            _execute(arguments)
    except UserError as error:
        say(f"[bold red]error:[/bold red] {escape(str(error))}", markup=True)
        sys.exit(2)
    except KeyboardInterrupt:
        say("stopped; run the same command again to go on")
        sys.exit(130)


def _execute(arguments: Sequence[str]) -> None:
    """Run the subcommand that the arguments name."""
    name = arguments[0].replace("_", "-") if arguments else ""
    if name in GROUPS:
        tyro.extras.subcommand_cli_from_dict(GROUPS[name], prog=f"illuminerf {name}", args=arguments[1:])
    elif name in COMMANDS:  # alone, so that hints about a mistyped option are of this command
        chosen = tyro.cli(COMMANDS[name], prog=f"illuminerf {name}", args=arguments[1:])
        if isinstance(chosen, StageCall):
            chosen.execute()
    else:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="illuminerf",
            description="Relight photographed objects. Also: "
            + ", ".join(f"illuminerf {name} --help" for name in GROUPS),
            args=arguments,
        )


__all__ = ["COMMANDS", "GROUPS", "Preset", "main"]
