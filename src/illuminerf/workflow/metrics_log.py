"""What a long run measures on its way: metrics.jsonl, and TensorBoard where that is asked for."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from illuminerf.workflow.atomic import write_bytes
from illuminerf.workflow.errors import UserError


class MetricsLog:
    """One line of JSON per record: {"kind": "train", "step": 100, ...}, without times, so that equal runs have equal
    files. A resumed run continues the file: records of steps that are done again are dropped first."""

    def __init__(self, folder: Path, first_step: int, tensorboard: bool = False) -> None:
        """Raises: UserError: TensorBoard is asked for and not installed."""
        self.path = folder / "metrics.jsonl"
        self.board = _board(folder / "tensorboard", first_step) if tensorboard else None
        kept = [line for line in _records(self.path) if line["step"] <= first_step]
        lines = [json.dumps(line, sort_keys=True) + "\n" for line in kept]
        self._last = lines[-1] if lines else ""
        write_bytes(self.path, "".join(lines).encode(), grows=True)

    def write(self, kind: str, step: int, values: dict[str, float], **only_for_board: float) -> None:
        """Record numbers after `step` finished steps; `only_for_board` is for what differs from run to run.

        A record like the last one is not repeated: a run that was stopped after its last step measures once more.
        """
        line = json.dumps({"kind": kind, "step": step, **values}, sort_keys=True) + "\n"
        if line != self._last:
            with open(self.path, "a", encoding="utf-8") as stream:
                stream.write(line)
            self._last = line
        if self.board is not None:
            for name, value in (values | only_for_board).items():
                self.board.add_scalar(f"{kind}/{name}", value, step)

    def picture(self, name: str, step: int, image: Float[np.ndarray, "height width 3"]) -> None:
        """Show an sRGB image in [0, 1]; only TensorBoard takes pictures."""
        if self.board is not None:
            self.board.add_image(name, image, step, dataformats="HWC")

    def close(self) -> None:
        """Flush."""
        if self.board is not None:
            self.board.close()


def _board(folder: Path, first_step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise UserError(
            "TensorBoard is not installed",
            got=str(error),
            fix="pip install 'illuminerf[training]', or leave TensorBoard out; metrics.jsonl is always written",
        ) from error
    return SummaryWriter(str(folder), purge_step=first_step + 1)


def _records(path: Path) -> list[dict[str, Any]]:
    """Whole lines only: the last one may have been cut off."""
    records = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []:
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict) and isinstance(record.get("step"), int):
            records.append(record)
    return records
