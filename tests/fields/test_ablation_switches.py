"""What is switched off for comparison is off, the rest stays, and the defaults are what they were."""

import numpy as np
import pytest
import torch

from illuminerf.fields.appearance import AppearanceConfig, AppearanceField, blend_radiance
from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.geometry_fit import GeometryLossConfig, geometry_loss, level_weights
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.proposal_sampling import ProposalConfig, interlevel_loss
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.ray_pool import gather_rays
from illuminerf.fields.storage import StoredField, load_field, save_field
from illuminerf.fields.surface import SurfaceConfig
from illuminerf.scene.cameras import sphere_cameras

GRID = HashGridConfig(3, 2, 10, 4, 16)
PARTS = {
    "default": {},
    "no_proposal": {"has_proposal": False},
    "camera": {"appearance": AppearanceConfig(GRID, 8, 16, 1, 2, 4, 8, radiance="camera")},
    "reflected": {"appearance": AppearanceConfig(GRID, 8, 16, 1, 2, 4, 8, radiance="reflected")},
    "predicted": {"radiance_normals": "predicted"},
    "shared": {"surface": SurfaceConfig(GRID, 16, HashGridConfig(2, 2, 9, 4, 8), has_normal_grid=False)},
}


def field_with(part: str) -> RadianceField:
    sizes = {
        "surface": SurfaceConfig(GRID, 16, HashGridConfig(2, 2, 9, 4, 8)),
        "appearance": AppearanceConfig(GRID, 8, 16, 1, 2, 4, 8),
        "proposal": ProposalConfig(GRID, 8),
        "num_proposal_samples": 6,
        "num_samples": 8,
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return RadianceField(FieldConfig(**(sizes | PARTS[part])))  # type: ignore[arg-type]


def rays(count: int = 16) -> tuple[torch.Tensor, ...]:
    directions = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    return -2 * directions, directions, torch.ones(count), torch.full((count,), 3.0)


def test_without_a_proposal_samples_are_even_and_as_many() -> None:
    even, usual = field_with("no_proposal").sample(*rays()), field_with("default").sample(*rays())
    widths = even.edges[:, 1:] - even.edges[:, :-1]
    torch.testing.assert_close(widths, torch.full_like(widths, 2 / 8))
    assert usual.edges.shape == even.edges.shape
    assert (usual.edges[:, 1:] - usual.edges[:, :-1]).std() > 1e-3  # the guard
    loss = interlevel_loss(even.edges, even.weights, even.proposal_edges, even.proposal_weights)
    assert float(loss) < 1e-9 and not loss.requires_grad


@pytest.mark.parametrize("kind", ["camera", "reflected"])
def test_one_radiance_field_is_one_of_the_two(kind: str) -> None:
    both, one = field_with("default").appearance, field_with(kind).appearance
    chosen = {name: value for name, value in both.state_dict().items() if name in one.state_dict()}
    assert len(chosen) == len(one.state_dict()) < len(both.state_dict())
    one.load_state_dict(chosen)
    generator = torch.Generator().manual_seed(1)
    places, directions, normals = (torch.randn(5, 3, generator=generator) for _ in range(3))
    directions, normals = (torch.nn.functional.normalize(v, dim=-1) for v in (directions, normals))
    of_both, of_one = both(places, directions, normals), one(places, directions, normals)
    wanted = of_both[:, :3] if kind == "camera" else of_both[:, 3:6]
    other = of_both[:, 3:6] if kind == "camera" else of_both[:, :3]
    torch.testing.assert_close(blend_radiance(of_one), wanted)
    assert (wanted - other).abs().max() > 1e-3


def test_shared_normal_features_are_those_of_the_distance() -> None:
    shared, own = field_with("shared").surface, field_with("default").surface
    assert shared.num_normal_levels == 3 and own.num_normal_levels == 2
    for surface, changes in ((shared, True), (own, False)):
        places = torch.rand(20, 3, generator=torch.Generator().manual_seed(2)) - 0.5
        before = surface.predicted_normals(places)
        with torch.no_grad():
            surface.grid.table.normal_(generator=torch.Generator().manual_seed(3))
        assert bool((surface.predicted_normals(places) - before).abs().max() > 1e-3) is changes


@pytest.mark.parametrize("part", PARTS)
def test_every_kind_can_be_fitted_stored_and_loaded(part: str, tmp_path) -> None:  # type: ignore[no-untyped-def]
    field = field_with(part)
    cameras = sphere_cameras(3, 2.5, 0.7, 8, 8, np.random.default_rng(0))
    cells = OccupiedCells(torch.ones(8, 8, 8, dtype=torch.bool))
    pool = gather_rays(cameras, np.ones((3, 8, 8), np.float32), cells)
    generator = torch.Generator().manual_seed(0)
    index = pool.draw(16, generator)
    target = torch.rand(len(pool), 3, generator=generator)
    config = GeometryLossConfig(first_levels=1)
    loss, _ = geometry_loss(
        field, config, pool, target, None, index, level_weights(field, config, torch.tensor(0.3)), generator
    )
    loss.backward()
    unused = {"appearance.glo.mlp.0.weight", "appearance.glo.mlp.2.weight"}
    assert {name for name, p in field.named_parameters() if p.grad is None} == unused
    save_field(tmp_path, StoredField(field, cells))
    again = load_field(tmp_path).field
    torch.testing.assert_close(again.sample(*rays()).weights, field.sample(*rays()).weights, atol=0, rtol=0)


@pytest.mark.parametrize("kind", ["density", "predicted"])
def test_colours_bend_the_normals_that_the_radiance_fields_see(kind: str) -> None:
    """Density normals leave the photographs no other way to explain a highlight than to bend the surface."""
    field = field_with({"density": "default"}.get(kind, kind))
    assert field.config.radiance_normals == kind
    origins, directions, near, far = rays()
    points = field.worth_shading(field.sample(origins, directions, near, far))
    points.weights = points.weights.detach()  # of colours, only the normals' way to the surface is left
    field.shade(points, field.shading_normals(points), directions).sum().backward()
    bent = {"density": field.surface.grid.table.grad, "predicted": field.surface.normal_grid.table.grad}  # type: ignore[union-attr]
    assert bool(bent[kind].any())
    assert all(gradient is None for name, gradient in bent.items() if name != kind)


def test_without_coarse_to_fine_all_levels_are_on_from_the_second_step() -> None:
    cameras = sphere_cameras(3, 2.5, 0.7, 8, 8, np.random.default_rng(0))
    cells = OccupiedCells(torch.ones(8, 8, 8, dtype=torch.bool))
    pool = gather_rays(cameras, np.ones((3, 8, 8), np.float32), cells)
    target, index = torch.full((len(pool), 3), 0.5), torch.arange(16)

    def learns_finest_level(share: float, progress: float) -> bool:
        field, generator = field_with("default"), torch.Generator().manual_seed(0)
        config = GeometryLossConfig(first_levels=1, coarse_to_fine_share=share)
        levels = level_weights(field, config, torch.tensor(progress))
        geometry_loss(field, config, pool, target, None, index, levels, generator)[0].backward()
        grid = field.surface.grid
        assert grid.table.grad is not None
        return bool(grid.table.grad[int(grid.layout[-1, 2]) :].any())

    assert learns_finest_level(0.0, 0.01) and learns_finest_level(0.5, 0.5)
    assert not learns_finest_level(0.5, 0.01)  # the guard


def test_appearance_without_a_blend_has_no_such_weights() -> None:
    names = set(AppearanceField(AppearanceConfig(GRID, 8, 16, radiance="camera")).state_dict())
    assert not any(name.startswith(("blend", "reflected")) for name in names)
