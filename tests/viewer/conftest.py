"""Shared: a run folder as relight leaves it, of an untrained field, which is an opaque sphere of radius 0.5."""

from pathlib import Path

import numpy as np
import pytest
import torch

from illuminerf.data.capture import write_capture
from illuminerf.fields.appearance import AppearanceConfig
from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.proposal_sampling import ProposalConfig
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.storage import StoredField, save_field
from illuminerf.fields.surface import SurfaceConfig
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh

_GRID = HashGridConfig(2, 2, 8, 4, 8)
NUM_CODES = 4


def save_sphere(folder: Path, seed: int, latents: torch.Tensor | None) -> None:
    torch.manual_seed(seed)
    config = FieldConfig(
        SurfaceConfig(_GRID, 8, _GRID, 8, initial_beta=3e-4),
        AppearanceConfig(_GRID, 8, 8, 1, 1, 4, 8),
        ProposalConfig(_GRID, 8),
        num_proposal_samples=32,
        num_samples=24,
    )
    field = RadianceField(config)
    with torch.no_grad():
        field.surface.head.weight.zero_()
        for parameter in field.surface.normal_mlp[2].parameters():
            parameter.zero_()  # normals point away from the origin
    save_field(folder, StoredField(field, OccupiedCells(torch.ones(16, 16, 16, dtype=torch.bool)), latents))
    (folder / "DONE").write_text("finished\n")


def write_run(folder: Path) -> Path:
    """Two finished lights and one that is not."""
    cameras = turntable_cameras(3, 3.0, 0.6, 24, 24)
    images = [np.full((24, 24, 4), 0.5, np.float32) for _ in range(3)]
    write_capture(folder / "capture", images, cameras, ["a", "b", "c"], 1.0, np.zeros(3), "masked")
    (folder / "capture" / "DONE").write_text("finished\n")
    save_sphere(folder / "geometry", 0, None)
    mesh = sphere_mesh(3)
    TriangleMesh(0.5 * mesh.vertices, mesh.faces, mesh.vertex_normals).save_glb(folder / "geometry" / "mesh.glb")
    for seed, name in ((1, "dawn"), (2, "dusk")):
        codes = 3 * torch.randn(NUM_CODES, 4, generator=torch.Generator().manual_seed(seed))
        save_sphere(folder / "lights" / name / "latent_nerf", seed, codes)
        light = np.full((16, 32, 3), 0.5 if name == "dawn" else 0.1, np.float32)
        light[:8] *= [1.0, 0.5, 0.2] if name == "dawn" else [0.1, 0.5, 1.0]
        EnvironmentMap(light).save(folder / "lights" / name / "cues" / "light.exr")
    (folder / "lights" / "noon" / "cues").mkdir(parents=True)
    return folder


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "sphere")
