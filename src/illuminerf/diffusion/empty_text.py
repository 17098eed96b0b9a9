"""The CLIP text encoder's answer to the empty string: the only text a relighting model ever hears (paper, supplement).

Written out here because a whole text-model library for one constant tensor is too much. Weights are read by the names
that Stable Diffusion folders use (`text_encoder/`); once computed, the tensor is stored with the model.
"""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.errors import UserError

FILE = "empty_text.safetensors"
_WEIGHTS = ("model.safetensors", "model.fp16.safetensors")


def load_empty_text(base: Path) -> Float[Tensor, "text_length width"]:
    """The empty string's embedding of the Stable-Diffusion-class folder `base`.

    Read from `text_encoder/empty_text.safetensors`, else computed from the text encoder's weights.

    Raises:
        UserError: neither is there, or the weights do not fit the configuration.
    """
    folder = base / "text_encoder"
    if (folder / FILE).is_file():
        return load_checkpoint(folder / FILE)[0]["embedding"].float()
    weights = next((folder / name for name in _WEIGHTS if (folder / name).is_file()), None)
    if weights is None:
        raise UserError(
            f"{folder} holds neither text encoder weights nor the embedding of the empty string",
            wanted=f"config.json with {_WEIGHTS[0]} or {_WEIGHTS[1]}, or {FILE}",
            fix="download the base again (illuminerf models download)",
        )
    config = read_json(folder / "config.json")
    tensors = {
        name.removeprefix("text_model."): value.float()
        for name, value in load_checkpoint(weights)[0].items()
        if not name.endswith("position_ids")
    }
    try:
        tokens = _empty_tokens(base, config, len(tensors["embeddings.token_embedding.weight"]))
        return _encoded(tokens, tensors, config)
    except (KeyError, RuntimeError) as error:
        raise UserError(f"{weights} does not fit its config.json", got=str(error), fix="download it again") from error


def save_empty_text(embedding: Float[Tensor, "text_length width"], base: Path) -> None:
    """Write what `load_empty_text` reads first."""
    save_checkpoint(base / "text_encoder" / FILE, {"embedding": embedding}, {})


def _empty_tokens(base: Path, config: dict[str, Any], vocabulary: int) -> Int[Tensor, " text_length"]:
    """Start, end, then padding to the full length. CLIP's two last tokens are start and end."""
    start, end = vocabulary - 2, vocabulary - 1
    # SD 1 pads with the end token; SD 2's tokenizer pads with "!", which is token 0.
    special = base / "tokenizer" / "special_tokens_map.json"
    if special.is_file():
        pad = read_json(special).get("pad_token", "<|endoftext|>")
        pads_with_end = (pad["content"] if isinstance(pad, dict) else pad) != "!"
    else:
        pads_with_end = config.get("hidden_act", "quick_gelu") == "quick_gelu"
    tokens = torch.full((config["max_position_embeddings"],), end if pads_with_end else 0)
    tokens[0], tokens[1] = start, end
    return tokens


@torch.no_grad()
def _encoded(
    tokens: Int[Tensor, " text_length"], tensors: dict[str, Tensor], config: dict[str, Any]
) -> Float[Tensor, "text_length width"]:
    """The causal pre-norm transformer of CLIP (Radford et al. 2021), last hidden state after the final norm."""
    length, heads = len(tokens), config["num_attention_heads"]
    epsilon = config.get("layer_norm_eps", 1e-5)

    def linear(name: str, features: Tensor) -> Tensor:
        return functional.linear(features, tensors[f"{name}.weight"], tensors[f"{name}.bias"])

    def norm(name: str, features: Tensor) -> Tensor:
        weight, bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]
        return functional.layer_norm(features, weight.shape, weight, bias, epsilon)

    def split(features: Tensor) -> Tensor:
        return features.reshape(length, heads, -1).transpose(0, 1)

    x = tensors["embeddings.token_embedding.weight"][tokens] + tensors["embeddings.position_embedding.weight"][:length]
    for index in range(config["num_hidden_layers"]):
        layer = f"encoder.layers.{index}"
        y = norm(f"{layer}.layer_norm1", x)
        query, key, value = (split(linear(f"{layer}.self_attn.{part}_proj", y)) for part in "qkv")
        attended = functional.scaled_dot_product_attention(query[None], key[None], value[None], is_causal=True)[0]
        x = x + linear(f"{layer}.self_attn.out_proj", attended.transpose(0, 1).reshape(length, -1))
        hidden = linear(f"{layer}.mlp.fc1", norm(f"{layer}.layer_norm2", x))
        x = x + linear(f"{layer}.mlp.fc2", _activation(hidden, config.get("hidden_act", "quick_gelu")))
    return norm("final_layer_norm", x)


def _activation(hidden: Tensor, name: str) -> Tensor:
    if name == "gelu":
        return functional.gelu(hidden)
    if name == "quick_gelu":
        return hidden * torch.sigmoid(1.702 * hidden)
    raise UserError("unknown activation of the text encoder", got=name, wanted="gelu or quick_gelu")
