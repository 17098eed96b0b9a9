"""ConvNets 1 to 3 against the paper's tables, at full size and without weights (meta device)."""

import pytest
import torch
from torch import nn

from illuminerf.diffusion.conditioning import (
    PAPER_EMBEDDING,
    PAPER_TOKENS,
    Conditioning,
    ConditioningConfig,
    ConvPyramid,
    PyramidConfig,
    SelfAttention,
    TextureConfig,
    TextureNetwork,
    padded_tokens,
    unlit,
)
from illuminerf.diffusion.cue_coding import encode_cues
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear
from tests.diffusion.tiny import TINY, random_condition_inputs

# (channels, size) after every convolution at 512 x 512, read off the paper's tables.
TABLE_1 = [
    (16, 512), (16, 512), (32, 256), (32, 256), (64, 128), (64, 128), (128, 64), (128, 64), (256, 32), (256, 32),
    (512, 16), (512, 16), (512, 8), (1024, 8),
]  # fmt: skip
TABLE_3 = [(16, 512), (16, 512), (32, 256), (32, 256), (96, 128), (96, 128), (256, 64), (320, 64)]


def convolution_shapes(network: nn.Module, image: torch.Tensor) -> list[tuple[int, int]]:
    shapes: list[tuple[int, int]] = []
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            layer.register_forward_hook(lambda _, __, out: shapes.append((out.shape[1], out.shape[2])))
    network(image)
    return shapes


@pytest.mark.parametrize(("channels", "config", "table"), [(4, PAPER_TOKENS, TABLE_1), (12, PAPER_EMBEDDING, TABLE_3)])
def test_every_layer_has_the_tables_shape(channels: int, config: PyramidConfig, table: list[tuple[int, int]]) -> None:
    with torch.device("meta"):
        network = ConvPyramid(channels, config)
        shapes = convolution_shapes(network, torch.empty(1, channels, 512, 512))
    assert shapes == table
    strides = [layer.stride[0] for layer in network if isinstance(layer, nn.Conv2d)]
    assert strides == [1] + [1, 2] * (len(config.widths) - 1) + [1]


def test_convnet_2_has_dilightnets_layers() -> None:
    with torch.device("meta"):
        network = TextureNetwork(TextureConfig())
        convolutions = [m for m in network.modules() if isinstance(m, nn.Conv2d | nn.ConvTranspose2d)]
        inputs = (torch.empty(1, channels, 512, 512) for channels in (4, 12, 3))
        assert network(*inputs).shape == (1, 12, 512, 512)
    found = [(m.in_channels, m.out_channels, m.kernel_size[0], m.stride[0]) for m in convolutions]
    block = [(128, 128, 3, 1)] * 2
    wanted = [(4, 32, 3, 1), (32, 64, 3, 2), (64, 128, 3, 2), *block * 4]
    wanted += [(128, 64, 4, 2), (64, 32, 4, 2), (32, 12, 3, 1)]
    assert found == wanted


def test_full_size_condition_shapes_and_parameters() -> None:
    with torch.device("meta"):
        conditioning = Conditioning(ConditioningConfig())
        condition = conditioning(torch.empty(2, 4, 512, 512), torch.empty(2, 12, 512, 512))
    assert condition.tokens.shape == (2, 77, 1024)
    assert condition.embedding.shape == (2, 320, 64, 64)
    widths = [4, *(c for c, _ in TABLE_1)]
    by_hand = sum(9 * a * b + b for a, b in zip(widths[:-1], widths[1:], strict=True))
    assert sum(p.numel() for p in conditioning.tokens.parameters()) == by_hand


def test_last_layers_start_at_zero_and_the_others_do_not() -> None:
    conditioning = Conditioning(TINY.conditioning)
    image, cues = random_condition_inputs(2, 32)
    condition = conditioning(image, cues)
    assert (condition.tokens == 0).all() and (condition.embedding == 0).all()
    assert condition.products.abs().max() > 0
    assert all(layer.weight.abs().max() > 0 for layer in list(conditioning.tokens)[:-1] if isinstance(layer, nn.Conv2d))


def test_flax_default_initialisation_has_variance_one_over_fan_in() -> None:
    torch.manual_seed(0)
    layer = ConvPyramid(64, PyramidConfig(widths=(256,), out_channels=8))[0]
    assert isinstance(layer, nn.Conv2d)
    assert float(layer.weight.detach().var()) * 9 * 64 == pytest.approx(1.0, rel=0.02)
    assert float(layer.weight.detach().abs().max()) <= 2 / (9 * 64) ** 0.5 / 0.879 + 1e-6
    assert (
        abs(float(nn.Conv2d(64, 256, 3).weight.detach().var()) * 9 * 64 - 1) > 0.5
    )  # PyTorch's own default is another


def test_products_are_texture_times_cues_elementwise() -> None:
    for config in (TINY.conditioning, ConditioningConfig(PyramidConfig((8, 8, 8), 16, 4), TextureConfig((8, 8, 8), 1))):
        conditioning = Conditioning(config)
        image, cues = random_condition_inputs(2, 32)
        products = conditioning(image, cues).products
        torch.testing.assert_close(products, conditioning.texture(image, cues, 0 * cues[:, :3]) * cues)
        assert (conditioning(image, 0 * cues).products == 0).all()
        changed = cues.clone()
        changed[:, 5, 3, 4] += 1
        difference = (conditioning(image, changed).products - products).abs()
        assert difference[:, 5, 3, 4].min() > 0
        difference[:, 5, 3, 4] = 0
        assert difference.max() == 0


def material_network() -> TextureNetwork:
    torch.manual_seed(0)
    return TextureNetwork(TextureConfig((8, 8, 32), 2, patch=4, is_material=True, num_attention=2))


def test_material_starts_as_a_rough_dielectric_of_the_unlit_image() -> None:
    albedo, shading = 0.05 + 0.9 * torch.rand(1, 3, 32, 32), 0.2 + 2 * torch.rand(1, 3, 32, 32)
    lit = srgb_from_linear((albedo * shading).clamp_max(1))
    seen = albedo * shading < 1
    image = torch.cat([lit, torch.ones(1, 1, 32, 32)], 1)
    texture = material_network()(image, torch.rand(1, 12, 32, 32), encode_cues(shading))
    assert (texture >= 0).all()
    assert (texture[:, :3] ** 2.2 - albedo)[seen].abs().max() < 0.02
    assert (texture[:, 9:] ** 2.2 - 0.04).abs().max() < 0.001 and texture[:, 3:9].max() < 0.02
    wrong = material_network()(image, torch.rand(1, 12, 32, 32), encode_cues(shading.flip(-1)))
    assert (wrong[:, :3] ** 2.2 - albedo)[seen].abs().mean() > 0.1


def test_unlit_images_are_straight_and_need_no_shading() -> None:
    torch.manual_seed(0)
    straight, alpha = torch.rand(1, 3, 8, 8), 0.1 + 0.9 * torch.rand(1, 1, 8, 8)
    image = torch.cat([straight * alpha, alpha], 1)
    unknown = unlit(image, torch.zeros(1, 3, 8, 8))
    torch.testing.assert_close(unknown, (linear_from_srgb(straight) ** (1 / 2.2) / 0.76).clamp_max(1.5))
    assert torch.isfinite(unlit(torch.zeros(1, 4, 8, 8), torch.zeros(1, 3, 8, 8))).all()


@pytest.mark.parametrize("is_material", [False, True])
def test_cues_and_shading_reach_the_texture_only_of_materials(is_material: bool) -> None:
    torch.manual_seed(0)
    network = material_network() if is_material else TextureNetwork(TextureConfig((8, 8, 32), 2, patch=4))
    for layer in (network.out, network.lit_out) if is_material else (network.out,):
        nn.init.normal_(layer.weight)
    image, cues = random_condition_inputs(2, 32)
    shading = cues[:, :3]
    texture = network(image, cues, shading)
    assert torch.equal(texture, network(image, 0 * cues, shading)) != is_material
    assert torch.equal(texture, network(image, cues, 0 * shading)) != is_material


def test_attention_starts_as_identity_and_then_reaches_every_place() -> None:
    torch.manual_seed(0)
    layer = SelfAttention(64)
    features = torch.randn(1, 64, 4, 5)
    assert torch.equal(layer(features), features)
    nn.init.normal_(layer.out.weight)
    changed = features.clone()
    changed[0, 3, 0, 0] += 5
    assert (layer(changed) - layer(features)).abs().sum(1).min() > 0
    plain = nn.MultiheadAttention(64, 2, batch_first=True)
    with torch.no_grad():
        plain.in_proj_weight.copy_(layer.project.weight[:, :, 0, 0])
        plain.in_proj_bias.copy_(layer.project.bias)
        plain.out_proj.weight.copy_(layer.out.weight[:, :, 0, 0])
        plain.out_proj.bias.copy_(layer.out.bias)
    places = layer.norm(features).flatten(2).transpose(1, 2)
    expected = features + plain(places, places, places)[0].transpose(1, 2).unflatten(-1, (4, 5))
    torch.testing.assert_close(layer(features), expected, atol=1e-5, rtol=1e-4)


def test_tokens_are_padded_with_zeros_from_64_to_77() -> None:
    features = torch.randn(2, 5, 8, 8)
    tokens = padded_tokens(features, 77)
    assert tokens.shape == (2, 77, 5)
    assert (tokens[:, 64:] == 0).all()
    torch.testing.assert_close(tokens[1, 8 * 3 + 2], features[1, :, 3, 2])
    with pytest.raises(ValueError, match="do not fit"):
        padded_tokens(torch.zeros(1, 5, 9, 9), 77)
