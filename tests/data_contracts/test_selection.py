"""Contracts of partly selected recordings: run and check observe the same messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from made_recordings import define, record

from mosaico_ingest import api
from mosaico_ingest.report.parts import ContractResult

START_NS = 1_700_000_000_000_000_000
TICK_NS = 100_000_000
RULE = "=" * 80
STAMPED = define(
    "demo_msgs/msg/Reading",
    "std_msgs/Header header\nint32 value\n"
    f"{RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
)


def header(time_ns: int) -> dict[str, Any]:
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": "base"}


def measured(contract: ContractResult | None) -> dict[str, tuple[str, Any]]:
    assert contract is not None
    return {one.key: (one.outcome.value, one.measured) for one in contract.results}


def both(folder: Path, settings: str) -> dict[str, tuple[str, Any]]:
    """Return the results of a run, and assert that a check has the same results."""
    record(
        folder / "drive.mcap",
        [
            (
                "/reading",
                STAMPED,
                START_NS + step * TICK_NS,
                {"header": header(START_NS + step * TICK_NS), "value": step},
            )
            for step in range(100)
        ],
    )
    (folder / "job.yaml").write_text(
        f"bag: {{path: drive.mcap{settings}\nsequence: {{name: drive}}\ntarget: {{store: store}}\n"
        "expect:\n  topics:\n    /reading:\n"
        "      messages: {max: 1000}\n      start: {within: 1 d}\n      out_of_order: 0\n"
        "      latency: {max: 1 h}\n      fields: {value: {min: -1, max: 1000, mean: {max: 1000}}}\n"
    )
    jobs = api.compile_job(folder / "job.yaml")
    (checked,) = api.check_recordings(folder / "job.yaml", jobs=jobs)
    (report,) = api.run(jobs).recordings
    assert report.exit_code == 0, report.error
    results = measured(report.contract)
    assert measured(checked.contract) == results
    return results


@pytest.mark.parametrize("stamp", ["log", "header"])
def test_contract_of_time_range_observes_only_the_range(tmp_path: Path, stamp: str) -> None:
    settings = f', time: {{start: "+2s", end: "+4s"}}}}\ntopic_settings: {{"*": {{stamp: {stamp}}}}}'
    results = both(tmp_path, settings)
    assert results["messages"] == ("passed", 20)
    assert results["fields.value.min"] == ("passed", 20)
    assert results["fields.value.max"] == ("passed", 39)
    assert results["fields.value.mean"] == ("passed", pytest.approx(29.5))


@pytest.mark.parametrize(
    ("rule", "mean"), [("every: 10", 45.0), ("where: value >= 90", 94.5), ("rate: 1 Hz", 45.0)]
)
def test_contract_of_values_observes_only_kept_messages(tmp_path: Path, rule: str, mean: float) -> None:
    results = both(tmp_path, f'}}\ntopic_settings: {{"*": {{{rule}}}}}')
    assert results["messages"] == ("passed", 100)
    assert results["fields.value.mean"] == ("passed", pytest.approx(mean))
