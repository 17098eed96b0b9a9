"""Where pretrained relighting models are found: the one inside the package, or a folder in the hub's layout."""

from importlib import resources
from pathlib import Path

import torch

from illuminerf.diffusion.relighting_model import RelightingModel, load_model
from illuminerf.workflow.errors import UserError

EMBEDDED = "embedded"


def model_folder(model: Path | str) -> Path:
    """The folder of "embedded" (shipped with the package) or of a model that was trained or downloaded.

    Raises:
        UserError: the folder holds no relighting model.
    """
    shipped = Path(str(resources.files("illuminerf"))) / "weights" / EMBEDDED
    folder = shipped if str(model) == EMBEDDED else Path(model)
    if not (folder / "relighting_model.json").is_file():
        raise UserError(
            f"{folder} holds no relighting model",
            wanted="relighting_model.json and the folders unet, controlnet, conditioning, vae",
            fix="name a folder made by train_relighting_model, or use 'embedded'",
        )
    return folder


def pretrained_model(model: Path | str, device: torch.device | str = "cpu") -> RelightingModel:
    """Load `model_folder(model)`, ready to sample."""
    return load_model(model_folder(model), device)
