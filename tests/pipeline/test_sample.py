"""A plan's sample converts the first messages of each topic in memory and reports rejections."""

from __future__ import annotations

import json
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.model import TimeRange
from mosaico_ingest.job.values import TimeBound
from mosaico_ingest.pipeline import preview as trial
from mosaico_ingest.pipeline.plan_document import RecordingPlan, Sample
from mosaico_ingest.pipeline.preview import preview

FLOAT = b"\0\1\0\0" + bytes(8)
START_NS = 1_700_000_000 * 10**9


def recording(folder: Path, payloads: dict[str, list[bytes]]) -> Path:
    """Write raw payloads of `std_msgs/msg/Float64`, one per second on each topic."""
    store = get_typestore(Stores.LATEST)
    with Ros2Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, items in payloads.items():
            connection = writer.add_connection(topic, "std_msgs/msg/Float64", typestore=store)
            for second, payload in enumerate(items):
                writer.write(connection, START_NS + second * 10**9, payload)
    return folder / "bag"


def planned(path: Path, **options: object) -> RecordingPlan:
    config = ROSInjectionConfig(path, "s", store=path.parent / "store", **options)  # type: ignore[arg-type] # a test's own
    return preview(config.job, connect=False)


def sample(plan: RecordingPlan, topic: str) -> Sample:
    return next(one for one in plan.samples if one.target == topic)


def test_sample_has_only_first_messages(tmp_path: Path) -> None:
    plan = planned(recording(tmp_path, {"/a": [FLOAT] * 500}))
    assert trial.MESSAGES <= sample(plan, "/a").read <= 2 * trial.MESSAGES
    assert sample(plan, "/a").rejected == 0
    assert plan.rejected == 0


def test_sample_counts_undecodable_messages_with_reason(tmp_path: Path) -> None:
    plan = planned(recording(tmp_path, {"/a": [FLOAT, FLOAT[:-3], FLOAT], "/b": [FLOAT]}))
    tried = sample(plan, "/a")
    assert (tried.read, tried.rejected, tried.rejections[0].count) == (3, 1, 1)
    assert tried.rejections[0].stage == "decode"
    assert sample(plan, "/b").rejected == 0
    assert plan.rejected == 1


def test_sample_includes_topic_that_starts_late(tmp_path: Path) -> None:
    late = [FLOAT] * 400
    path = recording(tmp_path, {"/a": late, "/late": []})
    assert sample(planned(path), "/late").read == 0
    (tmp_path / "more").mkdir()
    store = get_typestore(Stores.LATEST)
    with Ros2Writer(tmp_path / "more" / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        often = writer.add_connection("/often", "std_msgs/msg/Float64", typestore=store)
        rare = writer.add_connection("/rare", "std_msgs/msg/Float64", typestore=store)
        for second in range(2000):
            writer.write(often, START_NS + second * 10**9, FLOAT)
        writer.write(rare, START_NS + 2000 * 10**9, FLOAT)
    assert sample(planned(tmp_path / "more" / "bag"), "/rare").read == 1


def test_sample_respects_time_range(tmp_path: Path) -> None:
    path = recording(tmp_path, {"/a": [FLOAT[:-1]] * 5 + [FLOAT] * 5})
    window = TimeRange(start=TimeBound(5 * 10**9, relative=True))
    assert sample(planned(path, manifest={"bag": {"time": window}}), "/a").rejected == 0


def test_sample_ignores_error_policies(tmp_path: Path) -> None:
    path = recording(tmp_path, {"/a": [FLOAT[:-1]] * 3})
    plan = planned(path, on_error="delete", manifest={"on_error": {"message": "raise"}})
    assert sample(plan, "/a").rejected == 3
    assert plan.plan["on_error"]["message"] == "raise"


def test_estimated_bytes_depend_on_selected_rows(tmp_path: Path) -> None:
    path = recording(tmp_path, {"/a": [FLOAT] * 100})
    whole = planned(path).destination.estimated_bytes
    assert whole is not None
    assert whole >= 100 * 16
    assert (
        planned(path, manifest={"topic_settings": {"/a": {"every": 10}}}).destination.estimated_bytes
        == whole // 10
    )
    half = TimeRange(start=TimeBound(int(49.5e9), relative=True))
    assert planned(path, manifest={"bag": {"time": half}}).destination.estimated_bytes == whole // 2


def test_plan_digest_depends_only_on_decisions(tmp_path: Path) -> None:
    path = recording(tmp_path, {"/a": [FLOAT] * 3})
    plan = planned(path)
    assert planned(path).digest == plan.digest
    assert planned(path, manifest={"run": {"memory": 1 << 28}}).digest == plan.digest
    assert planned(path, manifest={"sequence": {"if_exists": "replace"}}).digest != plan.digest
    assert json.loads(plan.model_dump_json())["digest"] == plan.digest
