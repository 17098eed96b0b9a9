"""Work spread over processes: which share is ours, sums over all of them, and fits that they run together.

A launcher (torchrun, accelerate launch) tells each process its number in RANK and the count in WORLD_SIZE.
"""

import atexit
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed

from illuminerf.workflow import progress
from illuminerf.workflow.artefact import Artefact, fingerprint, open_artefact
from illuminerf.workflow.device import resolve_device
from illuminerf.workflow.errors import UserError

# a process that ends without a word is noticed at once; one that hangs ends all others after this
_PATIENCE = timedelta(minutes=30)


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


@dataclass(frozen=True)
class Team:
    """The processes that work on one fit together.

    Each step's rays are cut into contiguous shares of sizes that differ by one at most; what a process finds on its
    own share counts by that share's size, so that all together find what one process alone would.
    """

    index: int = 0
    """Number of this process."""
    count: int = 1
    """How many there are."""

    @property
    def is_first(self) -> bool:
        """Whether this process writes what all made; it does where it is alone."""
        return self.index == 0

    @property
    def is_alone(self) -> bool:
        return self.count == 1

    def own(self, total: int) -> slice:
        """This process's share of `total` things."""
        return slice(self.index * total // self.count, (self.index + 1) * total // self.count)

    def weight(self, total: int) -> float:
        """What a mean over this process's share of `total` things counts in the mean over all."""
        own = self.own(total)
        return (own.stop - own.start) / total

    def mean(self, value: Tensor, total: int) -> Tensor:
        """The mean over `total` things from the means over the shares; no gradient."""
        if self.is_alone:
            return value
        weighted = value.detach().cpu() * self.weight(total)
        with _explained():
            distributed.all_reduce(weighted)
        return weighted

    def sum(self, value: Tensor) -> Tensor:
        """The sum over all processes; no gradient."""
        if self.is_alone:
            return value
        summed = value.detach().cpu()
        with _explained():
            distributed.all_reduce(summed)
        return summed.to(value.device)

    def counts(self, own: int) -> list[int]:
        """A number from every process, in order."""
        if self.is_alone:
            return [own]
        counts = [torch.zeros(1, dtype=torch.int64) for _ in range(self.count)]
        with _explained():
            distributed.all_gather(counts, torch.tensor([own]))
        return [int(count) for count in counts]

    def agreed(self, finding: bool) -> bool:
        """What the first process found, for all."""
        return self.counts(int(finding))[0] > 0

    def sum_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Add the gradients of all processes up, in place; each has weighed its loss by `weight` before."""
        if self.is_alone:
            return
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        with _explained():
            for work in [distributed.all_reduce(gradient, async_op=True) for gradient in gradients]:
                work.wait()

    def start_equal(self, tensors: Iterable[Tensor]) -> None:
        """Give every process the first one's values."""
        if self.is_alone:
            return
        with torch.no_grad(), _explained():
            for tensor in tensors:
                distributed.broadcast(tensor, 0)


ALONE = Team()


@contextmanager
def _explained() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        raise UserError(
            "another process of this run has ended, or does not answer",
            got=str(error).splitlines()[0],
            fix="start the same command again: it goes on from the last checkpoint",
        ) from error


def join(device: str) -> tuple[Team, torch.device]:
    """The processes that a launcher started, and this one's device; one process alone without a launcher.

    Raises:
        UserError: CUDA is asked for where there is none, or a machine has more processes than GPUs.
    """
    index, count = shard_of("")
    place = resolve_device(device)
    if count == 1:
        return ALONE, place
    if place.type == "cuda":
        local = int(os.environ.get("LOCAL_RANK", "0"))
        if local >= torch.cuda.device_count() or place.index is not None:
            raise UserError(
                "each process needs a GPU of its own",
                got=f"process {local} of a machine with {torch.cuda.device_count()} GPUs, device {device}",
                fix="give torchrun --nproc-per-node at most the number of GPUs, and leave the device at auto or cuda",
            )
        place = torch.device("cuda", local)
        torch.cuda.set_device(place)
    if index > 0:
        progress.be_quiet()
    if not distributed.is_initialized():
        backend = "cpu:gloo,cuda:nccl" if place.type == "cuda" else "gloo"
        distributed.init_process_group(backend, timeout=_PATIENCE)
    return Team(index, count), place


def _close_group() -> None:
    if distributed.is_available() and distributed.is_initialized():
        distributed.destroy_process_group()


@contextmanager
def closed_at_exit() -> Iterator[None]:
    """Work of a process group, which is closed when this process ends, unless the work failed.

    Gloo's threads let go of a sum's tensors a while after the sum is known; one that does so while the interpreter
    shuts down aborts a process whose work is done. After a failure nothing is closed: others may never answer.
    """
    atexit.unregister(_close_group)
    yield
    atexit.register(_close_group)


@contextmanager
def open_together(team: Team, out: Path, stage: str, config: Any, inputs: dict[str, Path | str]) -> Iterator[Artefact]:
    """`open_artefact` for a team: the first process opens and writes it; the others wait for it at the end.

    Only the first may write, and only it calls `finish`.

    Raises:
        UserError: as `open_artefact`; or `out` is not finished at the end, or not seen by a process.
    """
    with closed_at_exit():
        if team.is_first:
            with open_artefact(out, stage, config, inputs) as artefact:
                team.agreed(artefact.is_done)
                yield artefact
            team.agreed(True)
            return
        is_done = team.agreed(False)
        yield Artefact(out, stage, is_done, finished=is_done)
        team.agreed(False)
        fingerprint(out)
