"""Where relighting models are found: inside the package, where downloads go, or a folder; and loading either kind."""

from importlib import resources
from pathlib import Path

import torch

from illuminerf.diffusion.controlled_base import (
    ControlledBase,
    ControlledBaseConfig,
    load_controlled,
    read_config,
    save_controlled,
)
from illuminerf.diffusion.dilightnet import is_published, load_published, published_config
from illuminerf.diffusion.frozen_base import load_base
from illuminerf.diffusion.hub import DILIGHTNET_CONTROL, KNOWN, find_base, placement, repository_folder
from illuminerf.diffusion.relighting_model import RelightingModel, load_model, save_model
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError

EMBEDDED = "embedded"
DILIGHTNET = "dilightnet"


def model_folder(model: Path | str) -> Path:
    """The folder of "embedded" (shipped with the package), "dilightnet" (once downloaded), or of a trained model.

    Raises:
        UserError: there is no relighting model.
    """
    shipped = Path(str(resources.files("illuminerf"))) / "weights" / EMBEDDED
    folder = shipped if str(model) == EMBEDDED else Path(model)
    if str(model) == DILIGHTNET and not folder.is_dir():
        folder = repository_folder(DILIGHTNET_CONTROL.id)
        if not is_published(folder):
            raise UserError(
                "the DiLightNet weights are not on this machine",
                wanted=placement(list(KNOWN[DILIGHTNET].repositories)),
                fix="run 'illuminerf models download dilightnet', or put the files there by hand",
            )
    if not (folder / "relighting_model.json").is_file() and not is_published(folder):
        raise UserError(
            f"{folder} holds no relighting model",
            wanted="relighting_model.json and the folders unet, controlnet, conditioning, vae",
            fix="name a folder made by train_relighting_model, or use 'embedded'",
        )
    return folder


def check_model(model: Path | str) -> None:
    """Find what is missing before hours are spent on other stages.

    Raises:
        UserError: there is no such model, or its base is not on this machine.
    """
    config = _controlled_config(model_folder(model))
    if config is not None:
        find_base(config.base, config.revision)


def _controlled_config(folder: Path) -> ControlledBaseConfig | None:
    """The configuration of a model that stands on a base; None for the embedded kind."""
    if is_published(folder):
        return published_config(folder)
    return read_config(folder) if "base" in read_json(folder / "relighting_model.json") else None


def pretrained_model(model: Path | str, device: torch.device | str = "cpu") -> RelightingModel | ControlledBase:
    """Load `model_folder(model)`, of either kind, ready to sample.

    Raises:
        UserError: a file is missing or corrupt, or the base is not on this machine.
    """
    folder = model_folder(model)
    config = _controlled_config(folder)
    if config is None:
        return load_model(folder, device)
    base = load_base(find_base(config.base, config.revision))
    loaded = load_published(folder, base) if is_published(folder) else load_controlled(folder, base)
    return loaded.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]


def save_relighter(model: RelightingModel | ControlledBase, folder: Path) -> None:
    """Write a model of either kind so that `pretrained_model` reads it."""
    if isinstance(model, ControlledBase):
        save_controlled(model, folder)
    else:
        save_model(model, folder)
