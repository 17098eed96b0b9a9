"""Training pairs: the items' form, their determinism, resuming, and broken objects by name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from illuminerf.cues.renderer import CueSampling
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.stages import render_training_pairs
from illuminerf.stages.render_training_pairs import Config
from illuminerf.workflow.artefact import fingerprint
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.checkpoint import load_checkpoint
from illuminerf.workflow.errors import UserError

CONFIG = Config(num_views=1, num_lights=2, size=24, samples_per_pixel=4, cue_sampling=CueSampling(4))


@pytest.fixture
def assets(tmp_path: Path) -> tuple[Path, Path]:
    models, lights = tmp_path / "models", tmp_path / "lights"
    models.mkdir()
    for name, mesh in (("ball", trimesh.creation.icosphere(2)), ("cube", trimesh.creation.box())):
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(baseColorFactor=[0.8, 0.3, 0.1, 1.0], roughnessFactor=0.6)
        )
        (models / f"{name}.glb").write_bytes(
            trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True)
        )
    (models / "broken.glb").write_bytes(b"nothing")
    generator = np.random.default_rng(0)
    for name in ("noon", "dusk", "night"):
        EnvironmentMap(generator.random((8, 16, 3)).astype(np.float32), name).save(lights / f"{name}.exr")
    return models, lights


def test_items_hold_what_training_needs(assets: tuple[Path, Path], tmp_path: Path) -> None:
    out = render_training_pairs.run(*assets, CONFIG, tmp_path / "pairs")
    manifest = read_json(out / "manifest.json")
    assert manifest["items"] == ["ball_0", "cube_0"]
    assert list(manifest["quarantined"]) == ["broken"] and "unreadable" in manifest["quarantined"]["broken"]
    tensors, metadata = load_checkpoint(out / "items" / "ball_0.safetensors")
    shapes = {name: (tuple(tensor.shape), tensor.dtype) for name, tensor in tensors.items()}
    assert shapes == {
        "targets": ((2, 3, 24, 24), torch.float16),
        "cues": ((2, 12, 24, 24), torch.float16),
        "alpha": ((24, 24), torch.uint8),
        "albedo": ((3, 24, 24), torch.uint8),
        "roughness": ((24, 24), torch.uint8),
        "metallic": ((24, 24), torch.uint8),
        "normal": ((3, 24, 24), torch.float16),
    }
    assert metadata["object"] == "ball" and metadata["split"] == "train" and len(metadata["lights"]) == 2
    assert metadata["lights"][0]["name"] != metadata["lights"][1]["name"]
    camera = Cameras.from_dict(metadata["camera"])
    _, directions = camera.image_rays(0)
    normal = tensors["normal"].float().permute(1, 2, 0)
    assert (normal * directions).sum(-1).max() <= 1e-2
    inside = tensors["alpha"] == 255
    assert 0.4 < inside.float().mean() < 0.9
    assert (tensors["targets"][:, :, tensors["alpha"] == 0].abs().amax()) < 0.2  # edge pixels of another seed only


def test_a_diffuse_object_is_albedo_times_its_cue(assets: tuple[Path, Path], tmp_path: Path) -> None:
    """Targets and cues are made separately, so agreement holds axes, light and exposure together."""
    config = replace(CONFIG, vary_probability=0.0, samples_per_pixel=64, cue_sampling=CueSampling(64))
    (assets[0] / "cube.glb").unlink()
    mesh = trimesh.creation.icosphere(3)
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[0.8, 0.3, 0.1, 1.0], roughnessFactor=1.0, metallicFactor=0.0
    )
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    (assets[0] / "ball.glb").write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True))
    out = render_training_pairs.run(*assets, config, tmp_path / "pairs")
    tensors, _ = load_checkpoint(out / "items" / "ball_0.safetensors")
    inside = tensors["alpha"] == 255
    targets, cues = tensors["targets"].float()[:, 0][:, inside], tensors["cues"].float()[:, 0][:, inside]
    ratio = targets / cues
    assert abs(ratio.median() - 0.8) < 0.08
    assert ratio.std() < 0.12
    swapped = targets / cues.flip(0)
    assert (swapped - 0.8).abs().mean() > (ratio - 0.8).abs().mean()


def test_resumed_equals_uninterrupted(assets: tuple[Path, Path], tmp_path: Path) -> None:
    whole = render_training_pairs.run(*assets, CONFIG, tmp_path / "whole")
    broken = render_training_pairs.run(*assets, CONFIG, tmp_path / "broken")
    (broken / "DONE").unlink()
    (broken / "items" / "cube_0.safetensors").unlink()
    render_training_pairs.run(*assets, CONFIG, broken)
    assert fingerprint(whole) == fingerprint(broken)
    other = render_training_pairs.run(*assets, replace(CONFIG, seed=1), tmp_path / "other")
    assert fingerprint(other) != fingerprint(whole)


def test_excluded_objects_are_named(assets: tuple[Path, Path], tmp_path: Path) -> None:
    out = render_training_pairs.run(*assets, replace(CONFIG, excluded=("cube",)), tmp_path / "pairs")
    manifest = read_json(out / "manifest.json")
    assert manifest["items"] == ["ball_0"]
    assert manifest["quarantined"]["cube"] == "excluded by name"


def test_the_object_fills_the_picture() -> None:
    thin = np.array([[0, 0, 1.0], [0, 0, -1.0], [0.1, 0, 0]])
    for seed in range(10):
        camera = render_training_pairs.item_camera(Config(size=64), thin, np.random.default_rng(seed))
        points, depth = camera.project(thin)
        reach = np.abs(points[0] / 32 - 1).max()
        assert (depth > 0).all() and reach == pytest.approx(1 / Config().margin, abs=1e-6)


def test_wrong_inputs_are_explained(assets: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no objects"):
        render_training_pairs.run(assets[1], assets[1], CONFIG, tmp_path / "a")
    with pytest.raises(UserError, match="too few lights"):
        render_training_pairs.run(*assets, replace(CONFIG, num_lights=4), tmp_path / "b")
    with pytest.raises(UserError, match="two lights"):
        Config(num_lights=1)
    with pytest.raises(UserError, match="probabilities"):
        Config(flip_probability=1.5)
