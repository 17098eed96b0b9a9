"""LatentNerf + Geometry -> RelitMesh: the relit object as a mesh that any 3D program shows."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from illuminerf.fields.baking import surface_colours
from illuminerf.fields.storage import StoredField, load_field
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.coloured_meshes import save_coloured_glb, save_coloured_ply, save_textured_glb
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.triangle_atlas import TriangleAtlas
from illuminerf.scene.views import spread_evenly
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.device import resolve_device
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

_POINTS_AT_ONCE = 1 << 14


@dataclass(frozen=True)
class Config:
    """How colours are baked."""

    texels_per_edge: int = 0
    """Steps between texels along a triangle's shorter sides in textured.glb; 0 leaves that file out. The presets'
    meshes are as fine as the photographs, so that colours of vertices lose nothing."""
    num_directions: int = 2
    """Directions over which the colour of a point is averaged."""
    num_samples: int = 8
    """Samples along the short ray that gives a point its colour."""
    max_viewpoints: int = 16
    """Cameras of the capture that directions are chosen from."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if min(self.num_directions, self.max_viewpoints) < 1 or self.num_samples < 2 or self.texels_per_edge < 0:
            raise UserError("texels, directions and viewpoints must be positive", got=str(self))


def run(latent_nerf_path: Path, geometry_path: Path, capture_path: Path, config: Config, out: Path) -> Path:
    """Bake the zero latent's colours onto the mesh.

    Args:
        latent_nerf_path: a LatentNerf, or a Geometry for the colours under the input light.
        geometry_path: the Geometry whose mesh.glb is painted.
        capture_path: the Capture; colours are those seen from about its cameras.
        config: the settings.
        out: the RelitMesh artefact: relit.glb (y-up, unlit) and relit.ply (z-up) with a colour per vertex; with
            texels_per_edge also textured.glb.

    Raises:
        UserError: something cannot be read, or the texture would be too large.
    """
    inputs: dict[str, Path | str] = {
        "field": latent_nerf_path,
        "geometry": geometry_path,
        "capture": capture_path,
    }
    with open_artefact(out, "bake_relit_mesh", config, inputs) as artefact:
        if artefact.is_done:
            return out
        mesh = TriangleMesh.load_glb(geometry_path / "mesh.glb")
        stored = load_field(latent_nerf_path, resolve_device(config.device))
        count = config.num_samples
        stored.field.config = replace(stored.field.config, num_samples=count, num_proposal_samples=2 * count)
        cameras = Cameras.from_dict(read_json(capture_path / "cameras.json"))
        chosen = spread_evenly(len(cameras), config.max_viewpoints)
        viewpoints = cameras.positions[chosen]
        mesh = replace(mesh, vertex_colors=_colours(stored, mesh.vertices, viewpoints, config.num_directions))
        save_coloured_glb(out / "relit.glb", mesh)
        save_coloured_ply(out / "relit.ply", mesh)
        if config.texels_per_edge:
            atlas = TriangleAtlas(len(mesh.faces), config.texels_per_edge)
            texture = _texture(stored, mesh, atlas, viewpoints, config.num_directions)
            save_textured_glb(out / "textured.glb", mesh, atlas, texture)
        artefact.finish({"num_faces": len(mesh.faces)})
    return out


def _colours(stored: StoredField, positions: np.ndarray, viewpoints: np.ndarray, num_directions: int) -> np.ndarray:
    chunks = np.array_split(positions, -(-len(positions) // _POINTS_AT_ONCE))
    return np.concatenate(
        [surface_colours(stored.field, chunk, viewpoints, num_directions) for chunk in track(chunks, "bake colours")]
    )


def _texture(
    stored: StoredField, mesh: TriangleMesh, atlas: TriangleAtlas, viewpoints: np.ndarray, num_directions: int
) -> np.ndarray:
    """The picture of the atlas, float32 [height, width, 3]."""
    face, barycentric = atlas.texels_of_cells(np.arange(atlas.num_cells))
    if atlas.texels_per_edge == 1:  # texels are vertices
        assert mesh.vertex_colors is not None
        corners, shares = mesh.vertex_colors[mesh.faces], np.clip(barycentric, 0, 1)
        shares = shares / shares.sum(-1, keepdims=True)
        return atlas.picture(np.einsum("ctk,ctkx->ctx", shares, corners[face]))
    positions = np.einsum("ctk,ctkx->ctx", barycentric, mesh.vertices[mesh.faces][face])
    colours = _colours(stored, positions.reshape(-1, 3), viewpoints, num_directions)
    return atlas.picture(colours.reshape(*face.shape, 3))
