"""NAME=FOLDER, as commands take the folders of several methods."""

from collections.abc import Sequence
from pathlib import Path

from illuminerf.workflow.errors import UserError


def named_folders(renderings: Sequence[str]) -> dict[str, Path]:
    """The folder of each name in `--renderings NAME=FOLDER ...`.

    Raises:
        UserError: a name or a folder is missing, or a name is given twice.
    """
    folders: dict[str, Path] = {}
    for argument in renderings:
        name, _, folder = argument.partition("=")
        if not name or not folder or name in folders or not Path(folder).is_dir():
            raise UserError(
                "renderings cannot be found by this",
                got=f"--renderings {argument}",
                wanted="NAME=FOLDER, each name once, each folder there",
                fix="check the name and the path",
            )
        folders[name] = Path(folder)
    return folders
