"""Training pairs on a real Ray cluster of two nodes, one of which is killed in the middle."""

from dataclasses import replace
from pathlib import Path

import pytest

from illuminerf.stages import render_training_pairs
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.task_pool import Execution
from tests.stages.test_render_training_pairs import CONFIG, VIEWS, shards, write_assets
from tests.workflow.elsewhere import two_nodes

pytestmark = pytest.mark.slow
CONFIG_OF_MANY = replace(CONFIG, views=replace(VIEWS, num_views=6), objects_per_shard=2)


def test_a_killed_node_loses_nothing(tmp_path: Path) -> None:
    models, lights = write_assets(tmp_path)
    out = tmp_path / "cluster"
    with two_nodes() as nodes:
        render_training_pairs.run(models, lights, CONFIG_OF_MANY, tmp_path / "alone")
        killed_after = nodes.kill_one_when(lambda: list(out.glob("staging/*/*.item")))
        render_training_pairs.run(models, lights, CONFIG_OF_MANY, out, Execution(ray_address=nodes.address))
        nodes.wait()
    assert 0 < len(killed_after[0]) < 18, "the node was killed in the middle"
    assert shards(out) == shards(tmp_path / "alone") and len(shards(out)) == 4


def test_an_absent_cluster_is_explained(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is an extra: pip install 'illuminerf[cluster]'")
    models, lights = write_assets(tmp_path)
    with pytest.raises(UserError, match="no Ray cluster answers at '127.0.0.1:1'"):
        render_training_pairs.run(models, lights, CONFIG, tmp_path / "out", Execution(ray_address="127.0.0.1:1"))
