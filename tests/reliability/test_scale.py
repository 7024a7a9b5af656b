"""Inputs of unusual proportions: many messages, topics, splits, bytes, sequences and recordings, a hundredth of the benchmark."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_benchmark_of_scale_stores_every_row_in_little_memory() -> None:
    command = [sys.executable, str(ROOT / "benchmarks/scale.py"), "--small"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    output = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout  # noqa: S603 - our own program
    rows = [[cell.strip() for cell in row.split("|")[1:-1]] for row in output.splitlines()[2:]]
    assert {row[0]: row[1] for row in rows} == {
        "1 topic x 10,000 messages": "10,000",
        "50 topics x 10 messages": "500",
        "100 splits x 1 message": "100",
        "0.5 GB by range, 1 topic": "10",
        "last page of 1,000 sequences": "10",
        "200 recordings": "200",
        "200 known recordings": "0",
    }
    assert all(int(row[3].removesuffix(" MiB")) < 300 for row in rows), output
