"""Values against the renderer that relights, gradients against differences, and the fit's grids against a plane."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from illuminerf.cues import differentiable_shading
from illuminerf.cues.differentiable_shading import DifferentiableShading
from illuminerf.cues.material_fit import FittedMaterials, MaterialFit, _Interpolation, photometric_loss
from illuminerf.cues.materials import Material
from illuminerf.cues.mitsuba_variant import find_llvm
from illuminerf.cues.shading import ShadedScene
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear
from illuminerf.scene.meshes import sphere_mesh
from illuminerf.workflow.errors import UserError

pytestmark = pytest.mark.skipif(find_llvm() is None, reason="gradients need libLLVM 19 or newer")
MESH, HEIGHT, SAMPLES = sphere_mesh(3, 0.7), 8, 64
CAMERAS = turntable_cameras(2, 3.0, 0.6, 24, 24)


@pytest.fixture(scope="module")
def shading() -> DifferentiableShading:
    return DifferentiableShading(MESH, HEIGHT, 3)


def values() -> list[Tensor]:
    """Base colour, roughness, metallic and light."""
    generator = torch.Generator().manual_seed(0)
    count = len(MESH.vertices)
    color = torch.rand(count, 3, generator=generator) * 0.4 + 0.3
    light = torch.rand(HEIGHT, 2 * HEIGHT, 3, generator=generator) * 2 + 0.1
    return [color, torch.full((count,), 0.4), torch.full((count,), 0.3), light]


def all_rays() -> tuple[Tensor, Tensor]:
    origins, directions = CAMERAS.image_rays(0)
    return origins.reshape(-1, 3), directions.reshape(-1, 3)


def test_radiance_is_that_of_the_renderer(shading: DifferentiableShading) -> None:
    color, roughness, metallic, _ = values()
    directions = EnvironmentMap(np.ones((HEIGHT, 2 * HEIGHT, 3), np.float32)).directions()
    lobe = np.exp(4 * (directions @ np.array([0.4, 0.7, 0.59]) - 1))[..., None]
    light = torch.from_numpy((0.1 + 2 * lobe * np.ones(3)).astype(np.float32))

    def found(light: Tensor) -> tuple[np.ndarray, np.ndarray]:
        radiance, hit = shading.radiance(color, roughness, metallic, light, all_rays(), SAMPLES, 0)
        return radiance.numpy(), hit.numpy()

    environment = EnvironmentMap(light.numpy())
    scene = ShadedScene([(MESH, Material(color.numpy(), roughness.numpy(), metallic.numpy()))], environment)
    rendered = scene.render(CAMERAS, 0, environment, SAMPLES, 1).reshape(-1, 4)
    radiance, hit = found(light)
    inside = hit & (rendered[:, 3] == 1)
    assert inside.sum() > 150 and not hit[rendered[:, 3] == 0].any()
    np.testing.assert_allclose(radiance[inside].mean(0), rendered[inside, :3].mean(0), rtol=0.03)

    def agreement(values: np.ndarray) -> float:
        return float(np.corrcoef(values[inside].ravel(), rendered[inside, :3].ravel())[0, 1])

    assert agreement(radiance) > 0.9
    # a light that is mirrored, upside down or turned by half its width would be noticed
    assert max(agreement(found(wrong)[0]) for wrong in (light.flip(1), light.flip(0), light.roll(HEIGHT, 1))) < 0.8


@pytest.mark.parametrize("which", range(4), ids=("colour", "roughness", "metallic", "light"))
def test_the_gradient_is_that_of_differences(shading: DifferentiableShading, which: int) -> None:
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(24 * 24, 3, generator=generator)
    step = torch.rand(values()[which].shape, generator=generator)
    leaves = [value.requires_grad_() for value in values()]
    (shading.radiance(*leaves, all_rays(), 4 * SAMPLES, 0)[0] * weights).sum().backward()

    def total(amount: float) -> float:
        moved = values()
        moved[which] = moved[which] + amount * step
        return float((shading.radiance(*moved, all_rays(), 4 * SAMPLES, 0)[0] * weights).sum())

    slope = (total(0.03) - total(-0.03)) / 0.06
    gradient = leaves[which].grad
    assert gradient is not None
    assert float((gradient * step).sum()) == pytest.approx(slope, rel=0.06)
    # that of another quantity is not
    others = [leaf.grad for index, leaf in enumerate(leaves) if index != which]
    assert all(
        float(other.sum()) / float(gradient.sum()) != pytest.approx(1, rel=0.06)
        for other in others
        if other is not None
    )


def test_paths_follow_from_the_seed(shading: DifferentiableShading) -> None:
    one, same, other = (shading.radiance(*values(), all_rays(), 4, seed)[0] for seed in (3, 3, 4))
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_grids_are_exact_for_a_plane_and_only_touch_what_is_near() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
    grid = _Interpolation(points, 5)
    assert grid.num_values <= 6**3
    # what the corners know of a plane: their own coordinates, found by least squares from the points alone
    corners = np.linalg.lstsq(grid.matrix.toarray(), points, rcond=None)[0].astype(np.float32)
    np.testing.assert_allclose(grid(torch.from_numpy(corners)).numpy(), points, atol=1e-5)
    np.testing.assert_allclose(np.asarray(grid.matrix.sum(1)), 1, atol=1e-6)
    leaf = torch.zeros(grid.num_values, 3, requires_grad=True)
    grid(leaf)[7].sum().backward()
    assert leaf.grad is not None
    assert (leaf.grad != 0).any(1).sum() <= 8 and leaf.grad.sum() == pytest.approx(3, abs=1e-5)


def test_the_loss_is_least_at_the_truth(shading: DifferentiableShading) -> None:
    """And white pixels say nothing of how bright they are, where the rendering is brighter."""
    config = MaterialFit(map_height=HEIGHT, color_sides=(4,), surface_sides=(2,), samples_per_ray=SAMPLES)
    light = EnvironmentMap(np.ones((HEIGHT, 2 * HEIGHT, 3), np.float32))
    found = FittedMaterials(MESH, light, config)
    rays = all_rays()
    wanted = srgb_from_linear(shading.radiance(*found.values(), rays, SAMPLES, 9)[0].detach())
    losses = {}
    for shift in (-0.5, 0.0, 0.5):
        found.log_light.data.fill_(shift)
        losses[shift] = float(photometric_loss(found, shading, rays, wanted, config, 0)[0].detach())
    assert losses[0.0] < 0.1 * min(losses[-0.5], losses[0.5])
    found.log_light.data.fill_(5.0)
    white = torch.ones_like(wanted)
    assert photometric_loss(found, shading, rays, white, config, 0)[0] == 0
    found.log_light.data.fill_(-5.0)
    assert photometric_loss(found, shading, rays, white, config, 0)[0] > 0.01


def test_the_prior_wants_a_smooth_grey_light() -> None:
    config = MaterialFit(map_height=HEIGHT, color_sides=(4,), surface_sides=(2,))
    even = EnvironmentMap(np.ones((HEIGHT, 2 * HEIGHT, 3), np.float32))
    red = EnvironmentMap(even.linear_rgb * np.array([2, 1, 1], np.float32))
    spotted = EnvironmentMap(np.random.default_rng(0).uniform(0.5, 2, even.linear_rgb.shape).astype(np.float32))
    priors = [float(FittedMaterials(MESH, light, config).prior()) for light in (even, red, spotted)]
    assert priors[0] == pytest.approx(0, abs=1e-9) and min(priors[1:]) > 1e-4


def test_what_cannot_be_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scalar = SimpleNamespace(variant=lambda: "scalar_rgb")
    monkeypatch.setattr(differentiable_shading, "load_mitsuba", lambda device: scalar)
    with pytest.raises(UserError, match="libLLVM"):
        DifferentiableShading(MESH, HEIGHT, 3)
    with pytest.raises(UserError, match="light"):
        MaterialFit(map_height=2)
    with pytest.raises(UserError, match="grids"):
        MaterialFit(color_sides=())
    with pytest.raises(UserError, match="starts"):
        MaterialFit(first_roughness=0.0)
