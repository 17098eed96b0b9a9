"""metrics.jsonl over interruptions."""

import json
from pathlib import Path

from illuminerf.workflow.metrics_log import MetricsLog


def test_a_resumed_log_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    whole = MetricsLog(tmp_path / "whole", 0)
    for step in range(1, 7):
        whole.write("train", step, {"loss": 1 / step}, examples_per_second=float(step))
    parts = MetricsLog(tmp_path / "parts", 0)
    for step in range(1, 6):  # two steps more than the last checkpoint, and a line that was cut off
        parts.write("train", step, {"loss": 1 / step})
    with open(parts.path, "a") as stream:
        stream.write('{"kind": "tr')
    resumed = MetricsLog(tmp_path / "parts", 3)
    for step in range(4, 7):
        resumed.write("train", step, {"loss": 1 / step})
    assert resumed.path.read_bytes() == whole.path.read_bytes()
    lines = [json.loads(line) for line in whole.path.read_text().splitlines()]
    assert lines[2] == {"kind": "train", "step": 3, "loss": 1 / 3}  # and nothing that differs from run to run


def test_a_record_made_twice_is_written_once(tmp_path: Path) -> None:
    """A run that is killed after its last record makes it again."""
    MetricsLog(tmp_path, 0).write("validation", 4, {"psnr": 20.0})
    resumed = MetricsLog(tmp_path, 4)
    resumed.write("validation", 4, {"psnr": 20.0})
    resumed.write("validation", 4, {"psnr": 21.0})
    assert [json.loads(line)["psnr"] for line in resumed.path.read_text().splitlines()] == [20.0, 21.0]


def test_a_fresh_run_starts_a_fresh_log(tmp_path: Path) -> None:
    MetricsLog(tmp_path, 0).write("train", 1, {"loss": 1.0})
    assert MetricsLog(tmp_path, 0).path.read_bytes() == b""
