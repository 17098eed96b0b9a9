"""Downloads: only on demand, checked, and explained where they fail. The hub is a stand-in."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from illuminerf.cli import main
from illuminerf.diffusion import hub
from illuminerf.diffusion.hub import DILIGHTNET_CONTROL, KNOWN, SD21, download, find_base, repository_folder
from illuminerf.diffusion.pretrained import pretrained_model
from illuminerf.diffusion.relighting_model import save_model
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import tiny_model, with_noise_in_every_weight


class StandInHub:
    """Serves every file with its own name as content."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, str, str]] = []

    def __call__(self, repository: str, path: str, *, revision: str, local_dir: Path) -> str:
        self.asked.append((repository, path, revision))
        target = Path(local_dir) / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(path)
        return str(target)


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StandInHub:
    stand_in = StandInHub()
    monkeypatch.setenv("ILLUMINERF_MODELS", str(tmp_path / "models"))
    monkeypatch.setattr(hub, "hf_hub_download", stand_in)
    sums = {file.path: hashlib.sha256(file.path.encode()).hexdigest() for file in SD21.files}
    honest = replace(SD21, files=tuple(replace(file, sha256=sums[file.path]) for file in SD21.files))
    known = replace(KNOWN["dilightnet"], repositories=(DILIGHTNET_CONTROL, honest))
    monkeypatch.setitem(KNOWN, "dilightnet", known)
    return stand_in


def test_files_land_where_the_loader_looks_and_stay(served: StandInHub) -> None:
    folders = download("dilightnet")
    assert folders == [repository_folder(DILIGHTNET_CONTROL.id), repository_folder(SD21.id)]
    assert len(served.asked) == 10 and all(path.endswith((".json", ".safetensors")) for _, path, _ in served.asked)
    assert {revision for name, _, revision in served.asked if name == SD21.id} == {SD21.revision}
    assert find_base(SD21.id) == folders[1]
    download("dilightnet")
    assert len(served.asked) == 10
    (folders[1] / "unet" / "config.json").write_text("damaged")
    download("dilightnet")
    assert served.asked[10:] == [(SD21.id, "unet/config.json", SD21.revision)]


def test_a_wrong_file_is_refused_and_removed(served: StandInHub) -> None:
    with pytest.raises(UserError, match="not the expected file"):
        download("paper")  # the real sums, which the stand-in cannot meet
    assert not (repository_folder(SD21.id) / "unet" / "config.json").exists()


def test_what_has_no_pinned_sum_is_held_to_the_hubs_and_to_the_first_download(served: StandInHub) -> None:
    download("dilightnet")
    folder, name = repository_folder(DILIGHTNET_CONTROL.id), "config.json"
    (folder / name).write_text("damaged")
    served.asked.clear()
    download("dilightnet")
    assert served.asked == [(DILIGHTNET_CONTROL.id, name, DILIGHTNET_CONTROL.revision)]
    assert (folder / name).read_text() == name
    note = folder / ".cache" / "huggingface" / "download" / f"{name}.metadata"
    note.parent.mkdir(parents=True)
    note.write_text(f"commit\n{'0' * 64}\n0.0\n")
    (folder / name).unlink()
    with pytest.raises(UserError, match="not the expected file"):
        download("dilightnet")


def test_another_base_and_revision(served: StandInHub) -> None:
    download("paper", base="someone/diffusion")
    assert ("someone/diffusion", "unet/diffusion_pytorch_model.safetensors", "main") in served.asked
    assert find_base("someone/diffusion") == repository_folder("someone/diffusion")
    served.asked.clear()
    download("dilightnet", revision="0123abc")
    asked = [(file.path, "0123abc") for file in DILIGHTNET_CONTROL.files]
    assert [entry[1:] for entry in served.asked if entry[0] == DILIGHTNET_CONTROL.id] == asked
    served.asked.clear()
    download("dilightnet", revision="0123abc")
    assert [entry[1:] for entry in served.asked] == asked
    with pytest.raises(UserError, match="base of its own"):
        download("dilightnet", base="someone/diffusion")


@pytest.mark.parametrize("error", [ConnectionError("no route"), OSError("offline mode is enabled")])
def test_a_failing_download_says_which_files_go_where(
    served: StandInHub, monkeypatch: pytest.MonkeyPatch, error: Exception, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: Any, **__: Any) -> str:
        raise error

    monkeypatch.setattr(hub, "hf_hub_download", fails)
    with pytest.raises(SystemExit) as stop:
        main(["models", "download", "dilightnet"])
    assert stop.value.code == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert printed.count("error:") == 1 and str(error) in printed
    for file in (*DILIGHTNET_CONTROL.files, *SD21.files):
        assert file.path in printed
    assert str(repository_folder(SD21.id)) in printed


def test_nothing_is_fetched_unasked(served: StandInHub, capsys: pytest.CaptureFixture[str]) -> None:
    main(["models", "list"])
    main(["models", "info", "embedded"])
    main(["models", "download", "embedded"])
    assert served.asked == []
    printed = capsys.readouterr().err
    for name in ("embedded", "dilightnet", "paper", "Parameters", "ships with the package"):
        assert name in printed


def test_bases_are_folders_or_ids(tmp_path: Path, served: StandInHub) -> None:
    assert find_base(str(tmp_path)) == tmp_path
    with pytest.raises(UserError, match="does not exist"):
        find_base(str(tmp_path / "absent"))
    with pytest.raises(UserError, match=r"models download paper --base a/b"):
        find_base("a/b")
    with pytest.raises(UserError, match="unknown model"):
        download("huge")


def test_export_writes_what_ships(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained = with_noise_in_every_weight(tiny_model())
    save_model(trained, tmp_path / "trained")
    main(["models", "export", str(tmp_path / "trained"), str(tmp_path / "shipped")])
    shipped = pretrained_model(tmp_path / "shipped")
    weights = trained.state_dict()
    assert all(
        torch.allclose(value, weights[name], rtol=1e-3, atol=1e-6) for name, value in shipped.state_dict().items()
    )
    sizes = [sum(path.stat().st_size for path in (tmp_path / f).rglob("*.safetensors")) for f in ("trained", "shipped")]
    assert sizes[1] < 0.7 * sizes[0]
    with pytest.raises(SystemExit):
        main(["models", "export", str(tmp_path / "trained"), str(tmp_path / "shipped")])
