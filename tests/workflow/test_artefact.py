import errno
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from illuminerf.workflow.artefact import fingerprint, open_artefact, read_metrics, verify
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


def test_what_file_managers_leave_behind_does_no_harm(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / ".DS_Store").write_text("opened before")
    make(tmp_path / "a")
    (tmp_path / "a" / ".DS_Store").write_text("and after")
    (tmp_path / "a" / "Thumbs.db").write_text("on Windows")
    assert make(tmp_path / "a")
    verify(tmp_path / "a")
    (tmp_path / "a" / "thumbs.txt").write_text("but this was put there")
    with pytest.raises(UserError, match="corrupt: thumbs.txt"):
        verify(tmp_path / "a")


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


def flip(path: Path, at: int = 0) -> None:
    """One bit, size and time kept."""
    content, stat = bytearray(path.read_bytes()), path.stat()
    content[at] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


@pytest.mark.parametrize(
    "name", ["values.json", "config.json", "inputs.json", "provenance.json", "checksums.json", "DONE"]
)
def test_a_flipped_bit_is_named_by_whoever_reads_the_folder(name: str, tmp_path: Path) -> None:
    make(tmp_path / "a")
    verify(tmp_path / "a")
    flip(tmp_path / "a" / name, 10)
    with pytest.raises(UserError, match=f"{name} is not what the stage wrote.*delete"):
        verify(tmp_path / "a")
    (tmp_path / "a" / "values.json").touch()  # else this process trusts what it wrote itself
    with pytest.raises(UserError, match="is not what the stage wrote"):
        fingerprint(tmp_path / "a")


def test_missing_and_new_files_are_named(tmp_path: Path) -> None:
    make(tmp_path / "a")
    (tmp_path / "a" / "notes.txt").write_text("new")
    with pytest.raises(UserError, match=r"notes\.txt is not what"):
        fingerprint(tmp_path / "a")
    (tmp_path / "a" / "notes.txt").unlink()
    (tmp_path / "a" / "config.json").unlink()
    with pytest.raises(UserError, match=r"config\.json is not what"):
        fingerprint(tmp_path / "a")


def test_folders_of_earlier_versions_are_read_and_compared(tmp_path: Path) -> None:
    make(tmp_path / "a")
    expected = fingerprint(tmp_path / "a")
    (tmp_path / "a" / "checksums.json").unlink()
    assert make(tmp_path / "a") and fingerprint(tmp_path / "a") == expected
    flip(tmp_path / "a" / "values.json")
    with pytest.raises(UserError, match="corrupt"):
        verify(tmp_path / "a")


def stopped(out: Path) -> None:
    """A stage that writes two files and stops."""
    with pytest.raises(KeyboardInterrupt), open_artefact(out, "toy", Config(), {"source": "light"}):
        write_json(out / "values.json", [1, 2, 3])
        write_json(out / "more.json", [4])
        raise KeyboardInterrupt


def test_an_unfinished_folder_with_a_damaged_file_is_begun_again(tmp_path: Path) -> None:
    out = tmp_path / "a"
    stopped(out)
    with open_artefact(out, "toy", Config(), {"source": "light"}):
        assert (out / "more.json").exists(), "what is whole is kept"
    flip(out / "values.json")
    with open_artefact(out, "toy", Config(), {"source": "light"}):
        assert not (out / "values.json").exists() and not (out / "more.json").exists()
    assert not make(out) and make(out)


def test_a_file_that_changes_before_the_end_is_not_sealed(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"values\.json changed while"):  # noqa: SIM117
        with open_artefact(tmp_path / "a", "toy", Config(), {}) as artefact:
            write_json(tmp_path / "a" / "values.json", [1])
            flip(tmp_path / "a" / "values.json")
            artefact.finish()
    assert not (tmp_path / "a" / "DONE").exists()


def test_a_kill_during_the_very_first_write_does_not_bar_the_folder(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / ".config.k3x.partial.json").write_text("{")
    assert not make(tmp_path / "a") and make(tmp_path / "a")


def test_a_failing_disk_is_said_in_one_line(tmp_path: Path) -> None:
    with (
        pytest.raises(UserError, match=r"cannot be read or written.*run the same command again"),
        open_artefact(tmp_path / "a", "toy", Config(), {}),
    ):
        raise OSError(errno.EIO, "Input/output error", str(tmp_path / "a" / "x"))
    with pytest.raises(OSError, match="refused"), open_artefact(tmp_path / "a", "toy", Config(), {}):
        raise OSError(errno.ECONNREFUSED, "refused")  # not the disk's
