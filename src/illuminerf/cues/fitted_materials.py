"""The files of a Materials artefact: a mesh with a principled material, and the light it was fitted under.

mesh.glb               the mesh in the capture's unit ball, its vertices coloured in base colour to look at
materials.safetensors  base_color [vertices, 3] linear, roughness and metallic [vertices], single precision
light.exr              the photographs' light
"""

from pathlib import Path

import numpy as np
import torch

from illuminerf.cues.materials import Material
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.errors import UserError

_NAMES = ("base_color", "roughness", "metallic")


def save_materials(folder: Path, mesh: TriangleMesh, material: Material, light: EnvironmentMap) -> None:
    """Write a mesh with its material per vertex and the light."""
    values = {name: np.ascontiguousarray(getattr(material, name), np.float32) for name in _NAMES}
    colors = srgb_from_linear(values["base_color"])
    TriangleMesh(mesh.vertices, mesh.faces, mesh.vertex_normals, colors).save_glb(folder / "mesh.glb")
    light.save(folder / "light.exr")
    save_checkpoint(folder / "materials.safetensors", {k: torch.from_numpy(v) for k, v in values.items()}, {})


def load_materials(folder: Path) -> tuple[TriangleMesh, Material]:
    """Read what `save_materials` wrote.

    Raises:
        UserError: a file is missing or damaged, or they do not belong together.
    """
    mesh = TriangleMesh.load_glb(folder / "mesh.glb")
    tensors, _ = load_checkpoint(folder / "materials.safetensors")
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    count = len(mesh.vertices)
    wanted = {"base_color": (count, 3), "roughness": (count,), "metallic": (count,)}
    if shapes != wanted:
        raise UserError(
            f"the materials in {folder} are not those of its mesh",
            got=str(shapes),
            wanted=str(wanted),
            fix="delete the folder and fit them again",
        )
    return mesh, Material(*(tensors[name].numpy() for name in _NAMES))
