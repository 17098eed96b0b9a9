"""Why an object cannot be used, in words that can be counted."""

from collections.abc import Callable
from typing import Literal

from illuminerf.workflow.errors import UserError

BrokenReason = Literal[
    "transparent",
    "empty",
    "unreadable",
    "degenerate",
    "not finite",
    "too large",
    "missing texture",
]


class BrokenObject(UserError):
    """An object that is left out of the training data.

    Attributes:
        reason: what kind of trouble it is:
            transparent: some of it lets light through, or has holes cut out by its texture;
            empty: no triangles (a point cloud, lines, cameras alone);
            unreadable: not the format that its suffix says, cut short, contradictory, or in need of an extension;
            degenerate: triangles without area only, a single point, a line;
            not finite: NaN or infinite positions;
            too large: more faces, bytes or pixels than `ObjectReading` allows;
            missing texture: a file that it names (image, buffer, material library) is not there.
    """

    def __init__(self, reason: BrokenReason, what: str, *, got: str = "", wanted: str = "", fix: str = "") -> None:
        super().__init__(what, got=got, wanted=wanted, fix=fix)
        self.reason: BrokenReason = reason

    def __reduce__(self) -> tuple[Callable[..., "BrokenObject"], tuple[str, ...]]:
        # a process pool hands errors over in pickles, which by themselves would be made again of the message alone
        return _made_again, (self.reason, self.what, self.got, self.wanted, self.fix)


def _made_again(reason: BrokenReason, what: str, got: str, wanted: str, fix: str) -> BrokenObject:
    return BrokenObject(reason, what, got=got, wanted=wanted, fix=fix)
