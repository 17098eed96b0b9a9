"""Other machines, all on this one: an S3 server, and a Ray cluster of two nodes of which one can be killed."""

import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def s3_bucket(name: str) -> Iterator[str]:
    """The URL of an empty bucket on a server of its own; processes started meanwhile find it too."""
    pytest.importorskip("s3fs", reason="S3 is an extra: pip install 'illuminerf[cluster]'")
    server = pytest.importorskip("moto.server", reason="the S3 server is absent: pip install 'moto[server]'")
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    running.start()
    host, port = running.get_host_and_port()
    import s3fs

    name = f"{name}-{uuid.uuid4().hex[:8]}"  # buckets outlive their server within a process
    with pytest.MonkeyPatch.context() as patch:
        for variable, value in (
            ("AWS_ENDPOINT_URL", f"http://{host}:{port}"),
            ("AWS_ACCESS_KEY_ID", "test"),
            ("AWS_SECRET_ACCESS_KEY", "test"),
            ("AWS_DEFAULT_REGION", "us-east-1"),
        ):
            patch.setenv(variable, value)
        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir(name)
        yield f"s3://{name}"
        s3fs.S3FileSystem.clear_instance_cache()
    running.stop()


class TwoNodes:
    """A Ray cluster."""

    def __init__(self) -> None:
        pytest.importorskip("ray", reason="Ray is an extra: pip install 'illuminerf[cluster]'")
        from ray.cluster_utils import Cluster

        node: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
        self._cluster = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
        self._lost = self._cluster.add_node(**node)
        self._killer: threading.Thread | None = None
        self.address: str = self._cluster.address

    def kill_one_when(self, is_time: Callable[[], Any]) -> list[Any]:
        """Kill one node as soon as `is_time` says something true; that is put into the list that is returned."""
        said: list[Any] = []

        def kill() -> None:
            while not (found := is_time()):
                time.sleep(0.02)
            said.append(found)
            self._cluster.remove_node(self._lost, allow_graceful=False)

        self._killer = threading.Thread(target=kill, daemon=True)
        self._killer.start()
        return said

    def wait(self) -> None:
        """Until the node is gone."""
        if self._killer is not None:
            self._killer.join(timeout=30)

    def stop(self) -> None:
        """End all processes."""
        self._cluster.shutdown()


@contextmanager
def two_nodes() -> Iterator[TwoNodes]:
    """A cluster that is gone afterwards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")  # else workers starve on a machine that is busy with other tests
        nodes = TwoNodes()
        try:
            yield nodes
        finally:
            nodes.stop()
