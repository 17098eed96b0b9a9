"""Training pairs written to a real S3 server on this machine."""

from pathlib import Path

import pytest

from illuminerf.diffusion.training_items import load_items
from illuminerf.stages import render_training_pairs
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.task_pool import Execution
from tests.stages.test_render_training_pairs import CONFIG, shards, write_assets

pytestmark = pytest.mark.slow
BUCKET = "training-pairs"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> str:
    pytest.importorskip("s3fs", reason="S3 is an extra: pip install 'illuminerf[cluster]'")
    server = pytest.importorskip("moto.server", reason="the S3 server is absent: pip install 'moto[server]'")
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    running.start()
    host, port = running.get_host_and_port()
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://{host}:{port}"),
        ("AWS_ACCESS_KEY_ID", "test"),
        ("AWS_SECRET_ACCESS_KEY", "test"),
        ("AWS_DEFAULT_REGION", "us-east-1"),
    ):
        monkeypatch.setenv(name, value)
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir(BUCKET)
    yield f"s3://{BUCKET}/run"
    s3fs.S3FileSystem.clear_instance_cache()
    running.stop()


def test_the_bucket_holds_the_same_shards(bucket: str, tmp_path: Path) -> None:
    assets = write_assets(tmp_path)
    render_training_pairs.run(*assets, CONFIG, tmp_path / "local")
    render_training_pairs.run(*assets, CONFIG, bucket, Execution(workers=1))
    storage, local = Storage(bucket), shards(tmp_path / "local")
    assert {name: storage.read(name) for name in local} == local and storage.exists("DONE")
    assert storage.names("staging") == []
    assert [item.name for item in load_items(bucket, 24)] == [item.name for item in load_items(tmp_path / "local", 24)]
    storage.write("pairs-000000.tar", b"spoiled")
    render_training_pairs.run(*assets, CONFIG, bucket)
    assert storage.read("pairs-000000.tar") == local["pairs-000000.tar"]
