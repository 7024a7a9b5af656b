"""Comparison of reports: new and missing topics, and changed rates, sizes and speeds."""

from __future__ import annotations

from run_reports import recording, run, topic

from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.recording import Report, TopicReport
from mosaico_ingest.report.summaries import ALL, Change, compare_reports


def with_topics(number: int, *topics: TopicReport) -> Report:
    return recording(number).model_copy(update={"topics": topics})


def aspects(changes: tuple[Change, ...]) -> set[tuple[str, str, str, str, str]]:
    return {(one.recording, one.topic, one.aspect, one.before, one.after) for one in changes}


def test_compare_equal_reports_has_no_changes() -> None:
    comparison = compare_reports(run(recording(1), recording(2)), run(recording(2), recording(1)))
    assert (comparison.changes, comparison.total, comparison.matched) == ((), 0, 2)


def test_compare_lists_new_and_missing_topics_and_recordings() -> None:
    before = run(recording(1), with_topics(2, topic("/a"), topic("/b")))
    after = run(with_topics(2, topic("/b"), topic("/c")), recording(3))
    changes = compare_reports(after, before).changes
    assert {
        ("drive_002", "/a", "topic", "missing now", ""),
        ("drive_002", "/c", "topic", "", "new"),
        ("drive_003", "", "recording", "", "new"),
        ("drive_001", "", "recording", "missing now", ""),
    } <= aspects(changes)


def test_compare_lists_changed_rate_size_and_status() -> None:
    before = run(with_topics(1, topic("/a")))
    slow = topic("/a", counts=(25,) * 20).model_copy(update={"stored_bytes": 10**6})
    after = run(with_topics(1, slow).model_copy(update={"status": RunStatus.WITH_ERRORS}))
    changes = {(one.topic, one.aspect): one for one in compare_reports(after, before).changes}
    assert changes["", "status"].after == "completed with errors"
    assert (changes["/a", "rate"].before, changes["/a", "rate"].after) == ("49.95 Hz", "24.95 Hz")
    size = changes["/a", "stored size per row"]
    assert (size.before, size.after, size.ratio) == ("100 B", "2.0 kB", 20)


def test_compare_small_changes_of_numbers_are_not_listed() -> None:
    before = run(with_topics(1, topic("/a", counts=(100,) * 20)))
    after = run(with_topics(1, topic("/a", counts=(99,) * 20)))
    assert compare_reports(after, before).changes == ()


def test_compare_slower_run_lists_the_speed() -> None:
    after = recording(1)
    before = after.model_copy(update={"duration_s": after.duration_s / 3})
    (change,) = compare_reports(run(after), run(before)).changes
    assert (change.aspect, change.recording) == ("messages per second", "drive_001")
    assert change.ratio is not None
    assert round(change.ratio, 3) == 0.333


def test_compare_recordings_with_other_names_are_compared_together() -> None:
    before = run(*(with_topics(at, topic("/a"), topic("/b")) for at in (1, 2)))
    after = run(*(with_topics(at, topic("/a", counts=(25,) * 20)) for at in (11, 12, 13)))
    changes = compare_reports(after, before).changes
    actual = {(one.topic, one.aspect) for one in changes}
    assert {("/b", "topic"), ("/a", "rate")} <= actual
    assert {one.recording for one in changes} == {ALL}


def test_compare_two_single_recordings_match_whatever_their_names() -> None:
    comparison = compare_reports(run(with_topics(1, topic("/a"))), run(with_topics(2, topic("/b"))))
    assert comparison.matched == 1
    assert {one.recording for one in comparison.changes} == {"drive_001"}


def test_compare_skipped_recording_has_no_missing_topics() -> None:
    skipped = recording(1, RunStatus.SKIPPED).model_copy(update={"topics": ()})
    (change,) = compare_reports(run(skipped), run(recording(1))).changes
    assert (change.aspect, change.before, change.after) == ("status", "completed", "skipped")
