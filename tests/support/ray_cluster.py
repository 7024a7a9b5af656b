"""A Ray cluster with two nodes on this machine, without usage statistics."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import ray
from ray.cluster_utils import Cluster

_ENVIRONMENT = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
_NODE: dict[str, Any] = {"num_cpus": 1, "memory": 2 << 30, "object_store_memory": 80 << 20}


@contextmanager
def two_nodes() -> Generator[Cluster]:
    """Start a head node and another node with one CPU each; stop both at the end."""
    with patch.dict(os.environ, _ENVIRONMENT):
        cluster = Cluster(initialize_head=True, head_node_args={**_NODE, "include_dashboard": False})
        try:
            cluster.add_node(**_NODE)
            cluster.wait_for_nodes(30)
            yield cluster
        finally:
            cluster.shutdown()


@contextmanager
def connected(address: str) -> Generator[None]:
    """Connect this process to a cluster."""
    ray.init(address, log_to_driver=False, logging_level="ERROR")
    try:
        yield
    finally:
        ray.shutdown()
