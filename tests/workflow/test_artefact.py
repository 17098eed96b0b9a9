import errno
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from illuminerf.workflow.artefact import fingerprint, open_artefact, read_metrics
from illuminerf.workflow.atomic import atomic_path, read_json, write_json
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class Config:
    steps: int = 3


def make(out: Path, config: Config | None = None, source: str = "light") -> bool:
    """Run a stage that writes one file; returns whether it was loaded."""
    with open_artefact(out, "toy", config or Config(), {"source": source}) as artefact:
        if artefact.is_done:
            return True
        write_json(out / "values.json", [1, 2, 3])
        artefact.finish({"psnr": 30.0})
    return False


def test_made_once_then_loaded(tmp_path: Path) -> None:
    assert not make(tmp_path / "a")
    assert make(tmp_path / "a")
    assert read_metrics(tmp_path / "a")["psnr"] == 30.0


def test_another_config_is_refused_and_the_field_named(tmp_path: Path) -> None:
    make(tmp_path / "a")
    with pytest.raises(UserError, match=r"config\.steps is 3 there and 4 here"):
        make(tmp_path / "a", Config(4))


def test_another_input_is_refused_and_named(tmp_path: Path) -> None:
    make(tmp_path / "a")
    with pytest.raises(UserError, match="input 'source' has changed"):
        make(tmp_path / "a", source="other light")


def test_a_changed_or_truncated_file_is_found(tmp_path: Path) -> None:
    make(tmp_path / "a")
    (tmp_path / "a" / "values.json").write_text("[1, 2")
    with pytest.raises(UserError, match="corrupt"):
        make(tmp_path / "a")


def test_unfinished_work_is_resumed_and_cannot_be_an_input(tmp_path: Path) -> None:
    class Killed(BaseException):
        pass

    with pytest.raises(Killed), open_artefact(tmp_path / "a", "toy", Config(), {"source": "light"}):
        raise Killed
    assert not (tmp_path / "a" / "DONE").exists()
    with pytest.raises(UserError, match="unfinished"):
        fingerprint(tmp_path / "a")
    assert not make(tmp_path / "a")
    assert make(tmp_path / "a")


def test_equal_work_has_equal_fingerprints(tmp_path: Path) -> None:
    make(tmp_path / "a")
    make(tmp_path / "b")
    assert fingerprint(tmp_path / "a") == fingerprint(tmp_path / "b")
    make(tmp_path / "c", Config(5))
    assert fingerprint(tmp_path / "a") != fingerprint(tmp_path / "c")


def test_strangers_files_are_not_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="not a run of this program"):
        make(tmp_path)
    with pytest.raises(UserError, match="is a file"):
        make(tmp_path / "thesis.tex")


def test_two_processes_cannot_share_a_folder(tmp_path: Path) -> None:
    with (
        open_artefact(tmp_path / "a", "toy", Config(), {}),
        pytest.raises(UserError, match="another process"),
        open_artefact(tmp_path / "a", "toy", Config(), {}),
    ):
        pass


def test_a_full_disk_is_said_in_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="disk is full"), atomic_path(tmp_path / "a.bin") as temporary:
        temporary.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_a_kill_in_the_middle_of_a_write_leaves_the_old_file(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", "old")
    code = (
        "import os, signal, sys; from pathlib import Path\n"
        "from illuminerf.workflow.atomic import atomic_path\n"
        "with atomic_path(Path(sys.argv[1])) as t:\n"
        "    t.write_text('ne'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.json")], env=os.environ)
    assert done.returncode == -signal.SIGKILL
    assert read_json(tmp_path / "a.json") == "old"


def test_broken_json_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        read_json(tmp_path / "a.json")
