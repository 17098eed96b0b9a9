"""The part that runs inside Blender: reads a job folder (`blender_job`) and writes its pictures.

Run by its path, by a Python that has the module `bpy` or by the program `blender`; of the folder's files it needs to
know only their names, and of Python only numpy. Blender 3.4 to 5.3 are known to work.

    python blender_worker.py FOLDER
    blender --background --factory-startup --python-exit-code 1 --python blender_worker.py -- FOLDER
"""

import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

_SENSOR_MILLIMETRES = 36.0
_PARENT = "ILLUMINERF_PARENT"
_LINEAR, _RAW = "Linear Rec.709" if bpy.app.version >= (4, 0) else "Linear", "Non-Color"


def main(folder: Path) -> None:
    """Render everything that the job names; the scene is built once."""
    job = json.loads((folder / "job.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    set_up_cycles(scene, job)
    set_up_camera(scene, job["camera"])
    with np.load(folder / "meshes.npz", allow_pickle=False) as file:
        arrays = dict(file)
    smooth, flat = [], []
    for index, material in enumerate(job["materials"]):
        own = own_material(folder, index, material)
        smooth.append(add_object(scene, arrays, index, own, is_smooth=True))
        flat.append(add_object(scene, arrays, index, own, is_smooth=False))
    lights = [load_image(folder / f"light_{i}.exr", _LINEAR) for i in range(job["num_lights"])]
    environment = set_up_world(scene, lights[0])
    diffuse, (glossy, lobe) = diffuse_material(), glossy_material()
    layer = scene.view_layers[0]
    for rendering in job["renderings"]:
        environment.image = lights[rendering["light"]]
        # how finely Cycles importance-samples the light; left to itself it takes a second per picture for that
        scene.world.cycles.sample_map_resolution = min(max(environment.image.size[0], 64), 8192)
        layer.material_override = {"own": None, "diffuse": diffuse, "glossy": glossy}[rendering["material"]]
        lobe.inputs["Roughness"].default_value = rendering["roughness"]
        is_flat = rendering["material"] == "diffuse"
        for objects, is_hidden in ((smooth, is_flat), (flat, not is_flat)):
            for thing in objects:
                thing.hide_render = is_hidden
        render(scene, rendering, folder)


def render(scene: Any, rendering: dict[str, Any], folder: Path) -> None:
    """Path trace one picture into a 32-bit EXR."""
    cycles, bounces = scene.cycles, rendering["bounces"]
    cycles.samples, cycles.seed = rendering["samples"], rendering["seed"]
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = bounces
    scene.render.filepath = str(folder / f"{rendering['name']}.exr")
    bpy.ops.render.render(write_still=True)


def set_up_cycles(scene: Any, job: dict[str, Any]) -> None:
    """A plain path tracer: a fixed number of paths, nothing clamped, nothing blurred; radiance written as it is."""
    settings, cycles = scene.render, scene.cycles
    settings.engine = "CYCLES"
    settings.film_transparent = True
    threads = os.environ.get("ILLUMINERF_RENDER_THREADS", "")
    if threads.isdigit() and int(threads) > 0:  # several processes on one machine share its cores
        settings.threads_mode, settings.threads = "FIXED", int(threads)
    settings.use_compositing = settings.use_sequencer = settings.use_motion_blur = False
    settings.use_persistent_data = True
    settings.resolution_percentage = 100
    settings.dither_intensity = 0
    picture = settings.image_settings
    picture.file_format, picture.color_mode, picture.color_depth, picture.exr_codec = "OPEN_EXR", "RGBA", "32", "ZIP"
    scene.view_settings.view_transform, scene.view_settings.look = "Raw", "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0, 1
    cycles.use_adaptive_sampling = False
    if bpy.app.version >= (3, 5):  # the only pattern in all releases since
        cycles.sampling_pattern, cycles.use_light_tree = "TABULATED_SOBOL", False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.blur_glossy = cycles.light_sampling_threshold = 0
    cycles.caustics_reflective = True
    cycles.use_guiding = cycles.use_fast_gi = False
    cycles.pixel_filter_type = "BOX"
    cycles.use_denoising = job["denoises"]
    if job["denoises"]:
        cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.device = "GPU" if job["device"].startswith("cuda") else "CPU"
    if cycles.device == "GPU":
        use_graphics_cards()


def use_graphics_cards() -> None:
    """Let Cycles render on every card that it can use."""
    preferences = bpy.context.preferences.addons["cycles"].preferences
    for kind in ("OPTIX", "CUDA"):
        cards = [device for device in preferences.get_devices_for_type(kind) if device.type == kind]
        if cards:
            preferences.compute_device_type = kind
            for card in cards:
                card.use = True
            return
    sys.exit("Cycles finds no CUDA device on this machine")


def set_up_camera(scene: Any, camera: dict[str, Any]) -> None:
    """A pinhole camera; Blender's camera looks along -z with y up, as ours."""
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", _SENSOR_MILLIMETRES
    data.lens = camera["focal_in_widths"] * _SENSOR_MILLIMETRES
    data.shift_x, data.shift_y = camera["shift_x"], camera["shift_y"]
    data.clip_start, data.clip_end = 1e-3, 1e4
    thing = bpy.data.objects.new("camera", data)
    thing.matrix_world = Matrix(camera["world_from_camera"])
    scene.collection.objects.link(thing)
    scene.camera = thing
    scene.render.resolution_x, scene.render.resolution_y = camera["width"], camera["height"]
    aspect = camera["pixel_aspect"]  # Blender wants both numbers to be 1 or more
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(1, 1 / aspect), max(1, aspect)


def set_up_world(scene: Any, light: Any) -> Any:
    """An environment light in our axes, which are Blender's without a rotation; returns the node of its image."""
    scene.world = bpy.data.worlds.new("light")
    scene.world.cycles.sampling_method = "MANUAL"
    tree = cleared(scene.world)
    environment = tree.nodes.new("ShaderNodeTexEnvironment")
    environment.projection, environment.interpolation, environment.image = "EQUIRECTANGULAR", "Linear", light
    background = tree.nodes.new("ShaderNodeBackground")
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(environment.outputs["Color"], background.inputs["Color"])
    tree.links.new(background.outputs["Background"], output.inputs["Surface"])
    return environment


def load_image(path: Path, color_space: str) -> Any:
    """A float picture whose values reach the renderer unchanged."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = color_space
    image.alpha_mode = "NONE"
    return image


def add_object(scene: Any, arrays: dict[str, np.ndarray], index: int, material: Any, is_smooth: bool) -> Any:
    """One part as an object, shaded by its vertex normals or by its faces."""
    faces = arrays[f"faces_{index}"]
    mesh = bpy.data.meshes.new(f"part_{index}")
    mesh.vertices.add(len(arrays[f"vertices_{index}"]))
    mesh.vertices.foreach_set("co", arrays[f"vertices_{index}"].ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    if bpy.app.version < (3, 6):  # later ones see it from loop_start
        mesh.polygons.foreach_set("loop_total", np.full(len(faces), 3, np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(len(faces), is_smooth))
    if f"uv_{index}" in arrays:
        corners = np.ascontiguousarray(arrays[f"uv_{index}"][faces.ravel()])
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", corners.ravel())
    for name, kind, field in (
        ("base_color", "FLOAT_COLOR", "color"),
        ("roughness", "FLOAT", "value"),
        ("metallic", "FLOAT", "value"),
    ):
        if f"{name}_{index}" in arrays:
            values = arrays[f"{name}_{index}"]
            if field == "color":
                values = np.concatenate([values, np.ones_like(values[:, :1])], 1)
            mesh.attributes.new(name, kind, "POINT").data.foreach_set(field, np.ascontiguousarray(values).ravel())
    mesh.update(calc_edges=True)
    mesh.validate()  # drops faces without area or with a corner named twice, which crash Blender
    if is_smooth:
        if bpy.app.version < (4, 1):  # without it normals of one's own are ignored
            mesh.use_auto_smooth = True
        mesh.normals_split_custom_set_from_vertices(arrays[f"normals_{index}"])
    mesh.materials.append(material)
    thing = bpy.data.objects.new(mesh.name, mesh)
    thing.cycles.shadow_terminator_geometry_offset = 0  # it would move shadows, which no other path tracer does
    scene.collection.objects.link(thing)
    return thing


def own_material(folder: Path, index: int, material: dict[str, Any]) -> Any:
    """The part's own material."""
    result = bpy.data.materials.new(f"own_{index}")
    tree = cleared(result)
    is_mix = material["kind"] == "mix"
    connect_surface(tree, mixed_lobes(tree, material) if is_mix else principled(tree, folder, index, material))
    return result


def principled(tree: Any, folder: Path, index: int, material: dict[str, Any]) -> Any:
    """Metallic-roughness as glTF means it."""
    node = tree.nodes.new("ShaderNodeBsdfPrincipled")
    node.distribution = "GGX"
    color, roughness, metallic = (node.inputs[name] for name in ("Base Color", "Roughness", "Metallic"))
    if material["kind"] == "constant":
        color.default_value = [*material["base_color"], 1]
        roughness.default_value, metallic.default_value = material["roughness"], material["metallic"]
        return node.outputs["BSDF"]
    if material["kind"] == "per_vertex":
        for name, field, target in (
            ("base_color", "Color", color),
            ("roughness", "Fac", roughness),
            ("metallic", "Fac", metallic),
        ):
            attribute = tree.nodes.new("ShaderNodeAttribute")
            attribute.attribute_name = name
            tree.links.new(attribute.outputs[field], target)
        return node.outputs["BSDF"]
    pictures = []
    for name, color_space in (("texture", _LINEAR), ("surface", _RAW)):
        picture = tree.nodes.new("ShaderNodeTexImage")
        picture.image = load_image(folder / f"{name}_{index}.exr", color_space)
        picture.interpolation, picture.extension = "Linear", "REPEAT"
        pictures.append(picture)
    separate = tree.nodes.new("ShaderNodeSeparateColor")
    tree.links.new(pictures[0].outputs["Color"], color)
    tree.links.new(pictures[1].outputs["Color"], separate.inputs["Color"])
    tree.links.new(separate.outputs["Red"], roughness)
    tree.links.new(separate.outputs["Green"], metallic)
    return node.outputs["BSDF"]


def mixed_lobes(tree: Any, material: dict[str, Any]) -> Any:
    """What the paper gives an object without any material: a diffuse and a glossy lobe of one colour, mixed."""
    diffuse, glossy = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeBsdfGlossy")
    glossy.distribution = "GGX"
    for node in (diffuse, glossy):
        node.inputs["Color"].default_value = [*material["base_color"], 1]
    diffuse.inputs["Roughness"].default_value = 0
    glossy.inputs["Roughness"].default_value = material["roughness"]
    mix = tree.nodes.new("ShaderNodeMixShader")
    mix.inputs[0].default_value = material["metallic"]
    tree.links.new(diffuse.outputs["BSDF"], mix.inputs[1])
    tree.links.new(glossy.outputs["BSDF"], mix.inputs[2])
    return mix.outputs[0]


def diffuse_material() -> Any:
    """White Lambertian."""
    material = bpy.data.materials.new("diffuse")
    tree = cleared(material)
    node = tree.nodes.new("ShaderNodeBsdfDiffuse")
    node.inputs["Color"].default_value = (1, 1, 1, 1)
    node.inputs["Roughness"].default_value = 0
    connect_surface(tree, node.outputs["BSDF"])
    return material


def glossy_material() -> tuple[Any, Any]:
    """A white GGX lobe, and the node whose roughness is to be set."""
    material = bpy.data.materials.new("glossy")
    tree = cleared(material)
    node = tree.nodes.new("ShaderNodeBsdfGlossy")
    node.distribution = "GGX"
    node.inputs["Color"].default_value = (1, 1, 1, 1)
    connect_surface(tree, node.outputs["BSDF"])
    return material, node


def connect_surface(tree: Any, socket: Any) -> None:
    """Make a shader the surface of its material."""
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(socket, output.inputs["Surface"])


def cleared(owner: Any) -> Any:
    """The empty node tree of a material or a world."""
    if bpy.app.version < (5, 0):  # from then on there always is one
        owner.use_nodes = True
    owner.node_tree.nodes.clear()
    return owner.node_tree


def end_with_parent() -> None:
    """Leave as soon as the process that wanted the pictures (ILLUMINERF_PARENT) is gone, even if it was killed.

    A thread watches, since the kernel's own signal comes when the thread that started this process ends. A wrapper
    may stand between the two processes, or a container hide one from the other; then only its own parent counts.
    """
    named = os.environ.get(_PARENT, "")
    if os.name != "posix" or not named.isdigit():
        return
    wanted, first = int(named), os.getppid()
    is_seen = is_running(wanted)

    def watch() -> None:
        while os.getppid() == first and (not is_seen or is_running(wanted)):
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def is_running(process: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


if __name__ == "__main__":
    end_with_parent()
    main(Path(sys.argv[-1]))
