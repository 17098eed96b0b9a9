"""Training pairs written to a real S3 server on this machine."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from illuminerf.diffusion.training_items import load_items
from illuminerf.stages import render_training_pairs
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.task_pool import Execution
from tests.stages.test_render_training_pairs import CONFIG, shards, write_assets
from tests.workflow.elsewhere import s3_bucket

pytestmark = pytest.mark.slow


@pytest.fixture
def bucket() -> Iterator[str]:
    with s3_bucket("training-pairs") as url:
        yield f"{url}/run"


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
