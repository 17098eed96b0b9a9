"""The published DiLightNet folder: names, channel order and results against layers in its own order."""

from pathlib import Path

import pytest
import torch
from diffusers import ControlNetModel

from illuminerf.diffusion.conditioning import Conditioning
from illuminerf.diffusion.controlled_base import ControlledBase
from illuminerf.diffusion.cue_coding import code_cues
from illuminerf.diffusion.dilightnet import DILIGHTNET, is_published, published_config, renamed_conditioning
from illuminerf.diffusion.hub import DILIGHTNET_CONTROL, SD21, repository_folder
from illuminerf.diffusion.pretrained import model_folder, pretrained_model, save_relighter
from illuminerf.diffusion.sampling import sample_relit
from illuminerf.scene.images import srgb_from_linear
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.config import to_json
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import random_condition_inputs
from tests.diffusion.tiny_base import WEIGHTS, PublishedEmbedding, tiny_config, write_base, write_published


@pytest.fixture
def published(tmp_path: Path) -> tuple[Path, PublishedEmbedding]:
    base = write_base(tmp_path / "base", prediction_type="v_prediction")
    embedding = write_published(tmp_path / "dilightnet", base)
    named = tiny_config(base, cue_coding="srgb8")
    write_json(tmp_path / "dilightnet" / "relighting_model.json", to_json(named))
    return tmp_path / "dilightnet", embedding


@torch.no_grad()
def test_the_loaded_embedding_is_the_published_one(published: tuple[Path, PublishedEmbedding]) -> None:
    folder, embedding = published
    model = pretrained_model(folder)
    assert isinstance(model, ControlledBase) and model.cue_coding == "srgb8"
    image, cues = random_condition_inputs(2, 32)
    condition = model.condition(image, cues)
    mask_first = torch.cat([image[:, 3:], image[:, :3], cues], 1)
    torch.testing.assert_close(condition.embedding, embedding(mask_first), atol=1e-6, rtol=1e-5)
    image_first = torch.cat([image, cues], 1)  # the order of its README
    assert (condition.embedding - embedding(image_first)).abs().max() > 1e-4
    assert torch.equal(condition.tokens, model.base.empty_text.expand(2, -1, -1))


@torch.no_grad()
def test_the_whole_prediction_is_diffusers_own(published: tuple[Path, PublishedEmbedding]) -> None:
    folder, embedding = published
    model = pretrained_model(folder)
    assert isinstance(model, ControlledBase)
    config = {k: v for k, v in read_json(folder / "config.json").items() if k not in ("_class_name",)}
    config.pop("shading_hint_channels")
    control = ControlNetModel.from_config(config)
    control.controlnet_cond_embedding = embedding
    control.load_state_dict(load_checkpoint(folder / WEIGHTS)[0])
    image, cues = random_condition_inputs(1, 32)
    latent, step = torch.randn(1, 4, 4, 4), torch.tensor([400])
    text = model.base.empty_text[None]
    down, middle = control(latent, step, text, torch.cat([image[:, 3:], image[:, :3], cues], 1), return_dict=False)
    expected = model.base.unet(
        latent, step, text, down_block_additional_residuals=down, mid_block_additional_residual=middle
    ).sample
    torch.testing.assert_close(model(latent, step, model.condition(image, cues)), expected, atol=1e-5, rtol=1e-5)
    assert (model.base.unet(latent, step, text).sample - expected).abs().max() > 1e-2


def test_the_published_names_and_shapes_fit_at_full_size() -> None:
    with torch.device("meta"):
        published = PublishedEmbedding((32, 64, 128), (16, 32, 96, 256), 320)
        wanted = Conditioning(DILIGHTNET.conditioning).state_dict()
    prefixed = {f"controlnet_cond_embedding.{name}": value for name, value in published.state_dict().items()}
    renamed = renamed_conditioning(prefixed)
    assert {k: v.shape for k, v in renamed.items()} == {k: v.shape for k, v in wanted.items()}
    assert (
        len(renamed) == len(prefixed) == 2 * (14 + 8 + 8)
    )  # convolutions and norms of ConvNet 2, convolutions of ConvNet 3


def test_hints_are_8_bit_pictures_over_black() -> None:
    linear, alpha = 2 * torch.rand(12, 6, 6), torch.rand(1, 6, 6)
    coded = code_cues(linear, alpha, "srgb8")
    levels = coded / alpha * 255
    torch.testing.assert_close(levels, levels.round(), atol=1e-3, rtol=0)
    assert float((coded / alpha).max()) <= 1 + 1e-6
    dark = linear < 0.9
    torch.testing.assert_close((coded / alpha)[dark], srgb_from_linear(linear)[dark], atol=0.51 / 255, rtol=0)
    assert not torch.allclose(code_cues(linear, alpha, "power"), coded, atol=0.05)


def test_v_prediction_of_the_base_is_followed(published: tuple[Path, PublishedEmbedding]) -> None:
    folder, _ = published
    model = pretrained_model(folder)
    assert model.noise_schedule().config.prediction_type == "v_prediction"
    image, cues = random_condition_inputs(1, 32)
    relit = sample_relit(model, image, cues, [[1, 2]], 3)
    assert relit.shape == (1, 2, 3, 32, 32) and torch.isfinite(relit).all()


def test_saved_again_it_is_an_ordinary_folder(published: tuple[Path, PublishedEmbedding], tmp_path: Path) -> None:
    model = pretrained_model(published[0])
    save_relighter(model, tmp_path / "ours")
    assert not is_published(tmp_path / "ours")
    again = pretrained_model(tmp_path / "ours").state_dict()
    assert all(torch.equal(value, again[name]) for name, value in model.state_dict().items())


def test_the_name_finds_the_download(
    published: tuple[Path, PublishedEmbedding], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ILLUMINERF_MODELS", str(tmp_path / "models"))
    monkeypatch.chdir(tmp_path / "base")
    with pytest.raises(UserError, match=r"models download dilightnet") as error:
        model_folder("dilightnet")
    for part in ("diffusion_pytorch_model.safetensors of dilightnet/DiLightNet", SD21.id, str(tmp_path / "models")):
        assert part in str(error.value)
    place = repository_folder(DILIGHTNET_CONTROL.id)
    place.parent.mkdir(parents=True)
    published[0].rename(place)
    assert isinstance(pretrained_model("dilightnet"), ControlledBase)
    (place / "relighting_model.json").unlink()
    assert published_config(place) == DILIGHTNET
    with pytest.raises(UserError, match="not on this machine"):
        pretrained_model("dilightnet")


def test_other_layers_are_refused(published: tuple[Path, PublishedEmbedding]) -> None:
    folder, _ = published
    tensors, _ = load_checkpoint(folder / WEIGHTS)
    save_checkpoint(folder / WEIGHTS, tensors | {"controlnet_cond_embedding.extra.weight": torch.zeros(1)}, {})
    with pytest.raises(UserError, match="unknown layer"):
        pretrained_model(folder)
    last = "controlnet_cond_embedding.conv_out.bias"
    save_checkpoint(folder / WEIGHTS, {k: v for k, v in tensors.items() if k != last}, {})
    with pytest.raises(UserError, match="do not fit"):
        pretrained_model(folder)
    config = read_json(folder / "config.json")
    write_json(folder / "config.json", config | {"conditioning_channels": 3})
    with pytest.raises(UserError, match="other inputs"):
        pretrained_model(folder)
