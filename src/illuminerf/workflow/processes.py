"""Work spread over processes: which share is ours, and sums over all of them.

A launcher (torchrun, accelerate launch) tells each process its number in RANK and the count in WORLD_SIZE.
"""

import os
import re

from torch import Tensor, distributed

from illuminerf.workflow.errors import UserError


def shard_of(text: str) -> tuple[int, int]:
    """("i/n") to (i, n): the i-th of n shares, from 0. "" means what the launcher says, else everything (0, 1).

    Raises:
        UserError: it is not of this form, or i is not below n.
    """
    if not text:
        return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if not match or int(match[1]) >= int(match[2]):
        raise UserError("not a share of the work", got=repr(text), wanted="i/n with i from 0 to n - 1, such as 0/4")
    return int(match[1]), int(match[2])


def sum_over_processes(tensor: Tensor) -> Tensor:
    """The sum of `tensor` over all processes of a distributed run; itself where there is only one."""
    if distributed.is_available() and distributed.is_initialized() and distributed.get_world_size() > 1:
        summed = tensor.detach().clone()
        distributed.all_reduce(summed)
        return summed
    return tensor
