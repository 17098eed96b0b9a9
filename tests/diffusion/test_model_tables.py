"""The paper's model at full size, without weights: counts and shapes."""

import pytest
import torch

from illuminerf.diffusion.model_tables import layer_tables, model_on_meta, parameter_counts
from illuminerf.workflow.errors import UserError
from tests.diffusion.test_conditioning import TABLE_1, TABLE_3


def test_paper_on_sd21_has_the_tables_shapes_and_the_known_counts() -> None:
    model = model_on_meta("paper")
    tables = layer_tables(model)
    assert [(row.shape[-1], row.shape[0]) for row in tables["ConvNet 1"][:-2]] == TABLE_1
    assert [row.shape for row in tables["ConvNet 1"][-2:]] == [(64, 1024), (77, 1024)]
    assert [(row.shape[-1], row.shape[0]) for row in tables["ConvNet 3"]] == TABLE_3
    assert tables["ConvNet 3"][-1].shape == (64, 64, 320)
    assert [(row.kind, row.shape) for row in tables["ConvNet 4"]] == [("(3, 1, 1)", (64, 64, 320))]
    counts = parameter_counts(model)
    assert counts["base UNet (frozen)"] == 865_910_724 and counts["base VAE (frozen)"] == 83_653_863  # as published
    frozen = counts["base UNet (frozen)"] + counts["base VAE (frozen)"]
    assert counts["trained"] + frozen == counts["all"]
    assert counts["trained"] == sum(value for name, value in counts.items() if name[:4] in ("Conv", "cont"))
    channels = [4, *(channels for channels, _ in TABLE_1)]
    pairs = zip(channels[:-1], channels[1:], strict=True)
    assert counts["ConvNet 1 (tokens)"] == sum(9 * a * b + b for a, b in pairs)


def test_one_denoising_step_at_full_size() -> None:
    model = model_on_meta("paper")
    with torch.device("meta"), torch.no_grad():
        condition = model.condition(torch.empty(2, 4, 512, 512), torch.empty(2, 12, 512, 512))
        latent = torch.empty(2, *model.latent_shape(512, 512))
        assert model(latent, torch.empty(2, dtype=torch.long), condition).shape == (2, 4, 64, 64)
        assert model.decode(latent).shape == (2, 3, 512, 512)


def test_dilightnet_has_no_convnet_1() -> None:
    tables = layer_tables(model_on_meta("dilightnet"))
    assert set(tables) == {"ConvNet 2", "ConvNet 3", "ConvNet 4"}
    assert [row.shape[-1] for row in tables["ConvNet 2"]] == [32, 64, *[128] * 9, 64, 32, 12]
    with pytest.raises(UserError, match="unknown model"):
        model_on_meta("stable")
