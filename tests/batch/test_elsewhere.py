"""Batches into a bucket, by processes here and by a Ray cluster that loses a node: the same bytes as in a folder."""

from pathlib import Path

import pytest

from illuminerf.batch.command import run_batch
from illuminerf.batch.driver import Retries
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.task_pool import Execution
from tests.batch import stand_ins
from tests.batch.test_batch import HERE, cells, contents, run
from tests.workflow.elsewhere import s3_bucket, two_nodes

pytestmark = pytest.mark.slow
NAMES = ("mug", "shoe", "vase")


def test_a_cluster_that_loses_a_node_fills_a_bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = tmp_path / "photos"
    run([stand_ins.job(name, photos, str(tmp_path / "here")) for name in NAMES], tmp_path / "here")
    monkeypatch.setenv(stand_ins.SECONDS_PER_VIEW, "0.15")
    with s3_bucket("batch") as url, two_nodes() as nodes:
        out, storage = f"{url}/shop", Storage(f"{url}/shop")
        jobs = [stand_ins.job(name, photos, out) for name in NAMES]
        said = nodes.kill_one_when(lambda: [name for name in storage.tree() if name.endswith("cues/DONE")])
        retries, execution = Retries(5, 0.5), Execution(ray_address=nodes.address)
        results = run_batch(jobs, out, execution, retries, 2, "", stand_ins.work, stand_ins.stages)
        nodes.wait()
        assert 0 < len(said[0]) < 6, "the node was killed in the middle"
        assert {result["state"] for result in results["jobs"].values()} == {"done"}
        assert contents(out, NAMES) == contents(tmp_path / "here", NAMES)


def test_a_batch_into_a_bucket_goes_on(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    run([stand_ins.job("mug", photos, str(tmp_path / "here"))], tmp_path / "here")
    with s3_bucket("batch") as url:
        job, scratch = stand_ins.job("mug", photos, url), tmp_path / "scratch"
        (photos / "mug" / "turntable.user").write_text("")
        assert run([job], url) == {"mug": "failed"}
        (photos / "mug" / "turntable.user").unlink()
        storage = Storage(url)
        storage.remove("mug/lights/evening/cues/DONE")
        storage.write("mug/shards/lights/evening/cues/0-of-2", b"")
        results = run_batch([job], url, HERE, None, 2, str(scratch), stand_ins.work, stand_ins.stages)
        assert results["jobs"]["mug"]["state"] == "done" and list(scratch.iterdir()) == []
        assert contents(url, ("mug",)) == contents(tmp_path / "here", ("mug",))
        assert storage.exists("status.html") and storage.exists("results.json")
        for name in storage.tree():
            storage.download(name, tmp_path / "back" / name)
    cell = cells(tmp_path / "back")["mug", "evening", "cues"]
    assert cell["num_done"] == cell["num_steps"] == 3
