from pathlib import Path

import pytest
import torch

from illuminerf.workflow.checkpoint import (
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)
from illuminerf.workflow.device import derived_seed, resolve_device, torch_generator
from illuminerf.workflow.errors import UserError


def test_round_trip_with_metadata(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c.safetensors", {"w": torch.arange(6.0).reshape(2, 3).T}, {"step": 7})
    tensors, metadata = load_checkpoint(tmp_path / "c.safetensors")
    torch.testing.assert_close(tensors["w"], torch.arange(6.0).reshape(2, 3).T)
    assert metadata == {"step": 7}


def test_a_resumed_optimiser_takes_the_same_steps(tmp_path: Path) -> None:
    def steps(parameter: torch.nn.Parameter, optimizer: torch.optim.Optimizer, first: int, last: int) -> None:
        for step in range(first, last):
            optimizer.zero_grad()
            ((parameter * (step + 1)) ** 2).sum().backward()
            optimizer.step()

    whole = torch.nn.Parameter(torch.ones(4))
    steps(whole, torch.optim.Adam([whole], lr=0.1), 0, 6)

    half = torch.nn.Parameter(torch.ones(4))
    optimizer = torch.optim.Adam([half], lr=0.1)
    steps(half, optimizer, 0, 3)
    save_checkpoint(tmp_path / "c.safetensors", {"p": half, **optimizer_tensors(optimizer)}, {})
    tensors, _ = load_checkpoint(tmp_path / "c.safetensors")
    resumed = torch.nn.Parameter(tensors["p"].clone())
    again = torch.optim.Adam([resumed], lr=0.1)
    restore_optimizer(again, tensors)
    steps(resumed, again, 3, 6)
    assert torch.equal(resumed, whole)

    forgetful = torch.nn.Parameter(tensors["p"].clone())
    steps(forgetful, torch.optim.Adam([forgetful], lr=0.1), 3, 6)
    assert not torch.equal(forgetful, whole), "without its moments the optimiser must differ"


def test_corrupt_and_missing_checkpoints_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="missing"):
        load_checkpoint(tmp_path / "absent.safetensors")
    (tmp_path / "c.safetensors").write_bytes(b"\xff" * 64)
    with pytest.raises(UserError, match="corrupt"):
        load_checkpoint(tmp_path / "c.safetensors")


def test_random_streams_are_named_and_repeatable() -> None:
    assert derived_seed(1, "a", 2) == derived_seed(1, "a", 2) != derived_seed(1, "a2")
    first, second = (torch.rand(3, generator=torch_generator(3, "x")) for _ in range(2))
    assert torch.equal(first, second)


def test_devices() -> None:
    assert resolve_device("cpu").type == "cpu"
    with pytest.raises(UserError, match="unknown device"):
        resolve_device("tpu")
    if not torch.cuda.is_available():
        with pytest.raises(UserError, match="CUDA was asked for"):
            resolve_device("cuda")
