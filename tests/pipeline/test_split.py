"""Splitting recordings: the parts equal a plain computation over the messages; event files, names and metadata."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stamped_messages import MESSAGES, SECOND, START_NS, Messages, write_stamped

from mosaico_ingest import RosbagInjector, ROSInjectionConfig, api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.split import SPLIT_KEY, read_events
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.pipeline import provenance, split
from mosaico_ingest.pipeline.topic import LATCHED_KEY
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.run import RunReport
from mosaico_ingest.rosbag.recording import Recording
from mosaico_ingest.services.status import Status


def every_second(path: Path, seconds: int = 10) -> Path:
    return write_stamped(path, [("/a", second * SECOND, 0) for second in range(seconds)])


def write_job(path: Path, **keys: object) -> Path:
    bag = {"path": path.name, **keys.pop("bag", {})}  # type: ignore[dict-item] - callers pass a dict
    manifest = {"version": 1, "bag": bag, "sequence": {"name": "s"}, "target": {"store": "store"}, **keys}
    job = path.parent / "job.yaml"
    job.write_text(json.dumps(manifest))
    return job


def run(path: Path, **keys: object) -> tuple[RunReport, Store]:
    report = api.run(write_job(path, **keys))
    return report, Store.open(path.parent / "store")


def stored(store: Store, topic: str) -> dict[str, list[tuple[int, int]]]:
    """Return the sorted times and values of a topic in each sequence that has it."""
    result: dict[str, list[tuple[int, int]]] = {}
    for info in store.sequences():
        if any(entry.name == topic for entry in info.topics):
            table = store.scan(info.name, topic).read_all()
            pairs = zip(table["timestamp_ns"].to_pylist(), table["value"].to_pylist(), strict=True)
            result[info.name] = sorted(pairs)
    return result


def names(store: Store) -> list[str]:
    return sorted(info.name for info in store.sequences())


BOUND = st.none() | st.integers(0, 6 * SECOND)


class Oracle:
    """A slow oracle that splits a recording message by message."""

    def __init__(
        self, messages: Messages, *, stamp: str, offset_ns: int, rate: float | None, every: int
    ) -> None:
        self.by_log = stamp == "log" and not offset_ns
        self.rate, self.every = rate, every
        self.messages = sorted(
            (
                (
                    topic,
                    START_NS + log,
                    (START_NS + log if stamp == "log" or not ns else ns) + offset_ns,
                    value,
                )
                for value, (topic, log, ns) in enumerate(messages)
            ),
            key=lambda message: message[1],
        )

    def parts(
        self, length_ns: int, start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[str, int, int]]:
        """Yield the name, start and end of each part that has a message of any topic."""
        times = [time for _, _, time, _ in self.messages]
        first = self.messages[0][1] if self.by_log else min(times)
        origin = start_ns if start_ns is not None else first
        for number in range(1, 100):
            start, end = origin + (number - 1) * length_ns, origin + number * length_ns
            end = end if end_ns is None else min(end, end_ns)
            if any(start <= time < end for time in times):
                yield f"s_{number:03}", start, end

    def rows(self, topic: str, start_ns: int, end_ns: int, *, latched: bool) -> list[tuple[int, int]]:
        own = [(time, value) for name, _, time, value in self.messages if name == topic]
        early = [row for row in own if row[0] < start_ns][-1:] if latched else []
        kept: list[tuple[int, int]] = []
        number, last, origin = -1, -1, None
        for time, value in own:
            inside = start_ns <= time < end_ns
            if self.by_log and not inside:
                continue
            number += 1
            if number % self.every or not inside:
                continue
            if self.rate is not None:
                origin = time if origin is None else origin
                interval = int(np.floor_divide(time - origin, SECOND / self.rate))
                if interval <= last:
                    continue
                last = interval
            kept.append((time, value))
        return sorted(early + kept)


@settings(max_examples=12, deadline=None)
@given(
    messages=MESSAGES,
    stamp=st.sampled_from(["log", "header"]),
    offset_ns=st.sampled_from([0, 0, 1_500_000_000, -700_000_001]),
    rate=st.sampled_from([None, None, 1.0]),
    every=st.integers(1, 2),
    length_ns=st.sampled_from([1, 2, 5]).map(lambda seconds: seconds * SECOND),
    bounds=st.tuples(BOUND, BOUND),
    suffix=st.sampled_from([".mcap", ".db3"]),
)
def test_split_by_length_equals_message_by_message_computation(
    *,
    messages: Messages,
    stamp: str,
    offset_ns: int,
    rate: float | None,
    every: int,
    length_ns: int,
    bounds: tuple[int | None, int | None],
    suffix: str,
) -> None:
    start_ns, end_ns = (None if bound is None else START_NS + bound for bound in bounds)
    oracle = Oracle(messages, stamp=stamp, offset_ns=offset_ns, rate=rate, every=every)
    parts = list(oracle.parts(length_ns, start_ns, end_ns))
    own: dict[str, object] = {"stamp": stamp, "time_offset": f"{offset_ns} ns", "every": every}
    if rate is not None:
        own["rate"] = f"{rate} Hz"
    time: dict[str, object] = {"latched": ["/b"]}
    if start_ns is not None:
        time["start"] = instant(start_ns)
    if end_ns is not None:
        time["end"] = instant(end_ns)
    with tempfile.TemporaryDirectory() as folder:
        path = write_stamped(Path(folder, f"r{suffix}"), messages)
        report, store = run(
            path, bag={"time": time}, split={"by": f"{length_ns} ns"}, topic_settings={"/*": own}
        )
        for topic, latched in (("/a", False), ("/b", True)):
            rows = {name: oracle.rows(topic, start, end, latched=latched) for name, start, end in parts}
            expected = {name: values for name, values in rows.items() if values}
            assert {name: values for name, values in stored(store, topic).items() if values} == expected
        assert names(store) == [name for name, _, _ in parts]
        if not parts:
            assert report.exit_code == 3
        else:
            assert report.exit_code == 0


def instant(ns: int) -> str:
    moment = np.datetime64(ns, "ns")
    return f"{moment}Z"


def test_split_by_length_names_parts_and_stores_their_times(tmp_path: Path) -> None:
    _, store = run(every_second(tmp_path / "r.mcap"), split={"by": "4 s"})
    assert names(store) == ["s_001", "s_002", "s_003"]
    assert stored(store, "/a")["s_003"] == [(START_NS + 8 * SECOND, 8), (START_NS + 9 * SECOND, 9)]
    assert store.sequence("s_002").metadata[SPLIT_KEY] == {
        "recording": "s",
        "part": 2,
        "start_ns": START_NS + 4 * SECOND,
        "end_ns": START_NS + 8 * SECOND,
    }


def test_split_latched_messages_start_every_part_and_are_marked(tmp_path: Path) -> None:
    messages = [("/map", 0, 0), *(("/a", second * SECOND, 0) for second in range(4))]
    _, store = run(
        write_stamped(tmp_path / "r.mcap", messages), bag={"time": {"latched": ["/map"]}}, split={"by": "2 s"}
    )
    assert stored(store, "/map") == {"s_001": [(START_NS, 0)], "s_002": [(START_NS, 0)]}
    topic = next(entry for entry in store.sequence("s_002").topics if entry.name == "/map")
    assert topic.metadata[LATCHED_KEY] == {"before_ns": START_NS + 2 * SECOND}


def test_split_conditions_apply_to_each_part_and_empty_parts_are_stored_without_rows(tmp_path: Path) -> None:
    path = every_second(tmp_path / "r.mcap")
    keys: dict[str, Any] = {
        "split": {"by": "5 s"},
        "sequence": {"name": "s", "if_exists": "skip"},
        "topic_settings": {"/a": {"where": "value < 2", "on_change": ["value"]}},
    }
    report, store = run(path, **keys)
    assert {info.name: info.rows for info in store.sequences()} == {"s_001": 2, "s_002": 0}
    assert [one.status for one in report.recordings] == [RunStatus.COMPLETED] * 2
    assert ["[empty-part]" in finding for finding in report.recordings[1].findings] == [True]
    assert report.exit_code == 0
    for verify in (False, True):
        statuses = api.job_status(tmp_path / "job.yaml", verify=verify)
        assert [one.status for one in statuses] == [Status.DONE] * 2
    report, _ = run(path, **keys)
    assert [one.status for one in report.recordings] == [RunStatus.SKIPPED] * 2


def test_split_repeated_run_skips_parts_and_completes_missing_parts(tmp_path: Path) -> None:
    path = every_second(tmp_path / "r.mcap")
    keys: dict[str, Any] = {"split": {"by": "5 s"}, "sequence": {"name": "s", "if_exists": "skip"}}
    _, store = run(path, **keys)
    store.delete_sequence("s_002")
    statuses = {one.sequence: one.status for one in api.job_status(tmp_path / "job.yaml")}
    assert statuses == {"s_001": Status.DONE, "s_002": Status.NEW}
    report, store = run(path, **keys)
    assert [one.status for one in report.recordings] == [RunStatus.SKIPPED, RunStatus.COMPLETED]
    assert names(store) == ["s_001", "s_002"]


def test_split_plan_counts_messages_of_each_part(tmp_path: Path) -> None:
    messages = [("/a", 0, 0), ("/b", 1, 0), ("/a", 3 * SECOND, 0), ("/a", 5 * SECOND, 0)]
    job = write_job(write_stamped(tmp_path / "r.mcap", messages), split={"by": "4 s"})
    document = api.plan_job(job)
    assert [recording.count_texts for recording in document.recordings] == [
        {"/a": "2 of 3", "/b": "1 of 1"},
        {"/a": "1 of 3", "/b": "0 of 1"},
    ]
    assert repr(document) == "<Plan s_001: 2 topics, 3 messages>\n<Plan s_002: 2 topics, 1 message>"


def test_plan_of_time_range_without_index_of_times_counts_only_recording(tmp_path: Path) -> None:
    path = write_stamped(tmp_path / "r.mcap", [("/a", 0, 0), ("/a", 5 * SECOND, 0)])
    keys: dict[str, Any] = {"bag": {"time": {"start": "+2s"}}, "topic_settings": {"/a": {"stamp": "header"}}}
    (recording,) = api.plan_job(write_job(path, **keys)).recordings
    assert recording.count_texts == {"/a": "? of 2"}
    assert not recording.is_empty


def test_split_changed_length_is_another_job(tmp_path: Path) -> None:
    path = every_second(tmp_path / "r.mcap")
    skip = {"name": "s", "if_exists": "skip"}
    run(path, split={"by": "5 s"}, sequence=skip)
    report, _ = run(path, split={"by": "4 s"}, sequence=skip)
    assert report.recordings[0].status is RunStatus.FAILED
    assert "another job" in str(report.recordings[0].error)


def test_split_digests_recording_once_for_all_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    digested: list[Path] = []
    digest = provenance._digest

    def counted(path: Path, *arguments: Any) -> str:
        digested.append(path)
        return digest(path, *arguments)

    monkeypatch.setattr(provenance, "_digest", counted)
    run(every_second(tmp_path / "once.mcap"), split={"by": "2 s"})
    assert len(digested) == 1


def test_split_by_log_time_reads_each_message_about_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ranges: list[tuple[int | None, int | None]] = []
    read = Recording.message_blocks

    def counted(self: Recording, *arguments: Any, **options: Any) -> Any:
        ranges.append((options.get("start_ns"), options.get("end_ns")))
        return read(self, *arguments, **options)

    monkeypatch.setattr(Recording, "message_blocks", counted)
    run(every_second(tmp_path / "r.mcap"), split={"by": "5 s"})
    assert ranges == [
        (START_NS, START_NS + 5 * SECOND),
        (START_NS + 5 * SECOND, START_NS + 10 * SECOND),
    ]


def test_split_by_header_stamp_reads_log_times_of_the_part_only(tmp_path: Path) -> None:
    messages = [("/a", second * SECOND, START_NS + (second - 3) * SECOND) for second in range(10)]
    path = write_stamped(tmp_path / "r.mcap", messages)
    jobs = api.compile_job(write_job(path, split={"by": "5 s"}, topic_settings={"/*": {"stamp": "header"}}))
    assert [
        None if job.part is None else (job.part.start_ns, job.part.read_from_ns, job.part.read_until_ns)
        for job in jobs
    ] == [
        (START_NS - 3 * SECOND, START_NS, START_NS + 4 * SECOND + 1),
        (START_NS + 2 * SECOND, START_NS + 5 * SECOND, START_NS + 9 * SECOND + 1),
    ]


def test_split_into_too_many_parts_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(split, "MAX_PARTS", 3)
    job = write_job(every_second(tmp_path / "r.mcap"), split={"by": "1 s"})
    with pytest.raises(ManifestError) as refused:
        api.compile_job(job)
    assert [finding.rule for finding in refused.value.findings] == ["too-many-parts"]


def test_split_unreadable_recording_fails_in_the_run(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    path.write_bytes(b"not a recording")
    report, _ = run(path, split={"by": "1 s"})
    assert [one.status for one in report.recordings] == [RunStatus.FAILED]


def test_injector_refuses_split_and_run_accepts_it(tmp_path: Path) -> None:
    config = ROSInjectionConfig(
        file_path=every_second(tmp_path / "r.mcap"),
        sequence_name="s",
        store=tmp_path / "store",
        manifest={"split": {"by": "5 s"}},
    )
    with pytest.raises(ManifestError):
        RosbagInjector(config).run()
    report = api.run([config])
    assert [one.sequence for one in report.recordings] == ["s_001", "s_002"]


@pytest.mark.parametrize(
    ("keys", "rule"),
    [
        ({"by": "0 s"}, "wrong-value"),
        ({"by": "1 s", "events": "e.csv"}, "conflicting-keys"),
        ({}, "conflicting-keys"),
        ({"by": "1 s", "name": "fixed"}, "wrong-value"),
        ({"by": "1 s", "name": "{part:3x}"}, "wrong-value"),
        ({"by": "1 s", "name": "{part}/x"}, "wrong-value"),
        ({"events": "missing.csv"}, "missing-file"),
    ],
)
def test_lint_wrong_split_reports_rule(tmp_path: Path, keys: Mapping[str, str], rule: str) -> None:
    job = write_job(every_second(tmp_path / "r.mcap"), split=keys)
    assert [finding.rule for finding in lint_paths([job], env={}).findings] == [rule]


def events(tmp_path: Path, text: str, **keys: object) -> Path:
    (tmp_path / "events.csv").write_text(text)
    return write_job(every_second(tmp_path / "r.mcap"), split={"events": "events.csv", **keys})


def test_events_become_sequences_with_their_metadata(tmp_path: Path) -> None:
    text = (
        "name,start,end,weather,count,share,id,is wet\n"
        'left turn,+1s,+3s,sunny,3,0.5,007,true\n"b, c",-2s,+30s,,,,,\n'
    )
    api.run(events(tmp_path, text))
    store = Store.open(tmp_path / "store")
    assert {name: [value for _, value in rows] for name, rows in stored(store, "/a").items()} == {
        "s_left_turn": [1, 2],
        "s_b_c": [7, 8, 9],
    }
    metadata = {
        k: v for k, v in store.sequence("s_left_turn").metadata.items() if not k.startswith("mosaico")
    }
    assert metadata == {
        "weather": "sunny",
        "count": 3,
        "share": 0.5,
        "id": "007",
        "is wet": True,
        SPLIT_KEY: {
            "recording": "s",
            "part": 1,
            "event": "left turn",
            "start_ns": START_NS + SECOND,
            "end_ns": START_NS + 3 * SECOND,
        },
    }


def test_events_with_epoch_times_and_template_name(tmp_path: Path) -> None:
    text = f"start,end\n{START_NS // SECOND + 1}.5,{START_NS + 4 * SECOND}\n"
    api.run(events(tmp_path, text, name="{sequence}-{part:02d}-{event}"))
    store = Store.open(tmp_path / "store")
    assert [value for _, value in stored(store, "/a")["s-01-1"]] == [2, 3]


def test_events_outside_and_overlapping_are_findings_of_the_plan(tmp_path: Path) -> None:
    job = events(tmp_path, "name,start,end\na,+1s,+4s\nb,+3s,+5s\nc,2020-01-01,2020-01-02\n")
    document = api.plan_job(job)
    findings = [
        (note.rule, (note.location or "::").split(":")[1])
        for recording in document.recordings
        for note in recording.notes
    ]
    assert [one for one in findings if one[0].startswith("event-")] == [
        ("event-outside", "4"),
        ("event-overlap", "3"),
    ]


def test_events_all_outside_fail_with_nothing_matched(tmp_path: Path) -> None:
    report = api.run(events(tmp_path, "name,start,end\nc,2020-01-01,2020-01-02\n"))
    assert report.exit_code == 3


@pytest.mark.parametrize(
    ("text", "rule", "line"),
    [
        ("", "event-file", 1),
        ("name,start\na,+1s\n", "event-file", 1),
        ("start,start,end\n+1s,+1s,+2s\n", "event-file", 1),
        ("name,start,end\n", "event-file", 1),
        ("name,start,end\na,+1s\n", "event-file", 2),
        ("name,start,end\na,+1s,soon\n", "event-file", 2),
        ("name,start,end\na,+1s,+2s\n\na,+2s,+3s\n", "event-file", 4),
        ('name,start,end\n"a\nb",+1s,+2s\nc,x,+3s\n', "event-file", 4),
        ('name,start,end\n"a,+1s,+2s\n', "event-file", 1),
        ("name,start,end\na,+2s,+1s\n", "event-interval", 2),
        ("name,start,end\na,2026-01-01,2026-01-01\n", "event-interval", 2),
        ("name,start,end\na,+1s,+3s\nb,+2s,+4s\n", "event-overlap", 3),
    ],
)
def test_lint_event_file_reports_rule_and_line(tmp_path: Path, text: str, rule: str, line: int) -> None:
    findings = lint_paths([events(tmp_path, text)], env={}).findings
    assert [(finding.rule, finding.span and finding.span.line) for finding in findings] == [(rule, line)]
    if rule != "event-overlap":
        with pytest.raises(ManifestError) as refused:
            api.compile_job(tmp_path / "job.yaml")
        assert [finding.rule for finding in refused.value.findings] == [rule]


def test_events_reversed_only_in_the_recording_are_refused(tmp_path: Path) -> None:
    job = events(tmp_path, "name,start,end\na,+5s,-8s\n")
    assert lint_paths([job], env={}).findings == ()
    with pytest.raises(ManifestError) as refused:
        api.compile_job(job)
    assert [finding.rule for finding in refused.value.findings] == ["event-interval"]


def test_read_events_without_utf8_is_a_finding(tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_bytes(b"name,start,end\n\xff,+1s,+2s\n")
    assert [finding.rule for finding in read_events(path).findings] == ["event-file"]
