"""Every topic of every real recording can be described, plotted and shown, or the reason is stated."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from mosaico_ingest import RosbagInjector, ROSInjectionConfig
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError
from mosaico_ingest.view.columns import describe_topic
from mosaico_ingest.view.pictures import has_pictures, row_picture
from mosaico_ingest.view.rows import first_rows, last_rows, nearest_row
from mosaico_ingest.view.series import chart_lines, plot_fields, read_series
from mosaico_ingest.view.texts import json_value, scalar_text
from mosaico_ingest.view.tracks import local_meters, read_track


def ingested(corpus: Path, folder: Path) -> Store:
    """Return a store with every recording that can be ingested without options."""
    with (corpus / "INDEX.tsv").open(encoding="utf-8", newline="") as file:
        paths = [row["path"] for row in csv.DictReader(file, delimiter="\t")]
    for number, path in enumerate(paths):
        config = ROSInjectionConfig(file_path=corpus / path, sequence_name=f"r{number}", store=str(folder))
        try:
            RosbagInjector(config).run()
        except IngestError:
            continue  # other tests state why
    return Store.open(folder, create=False)


@pytest.mark.slow
def test_all_topics_of_corpus_can_be_shown(corpus: Path, tmp_path: Path) -> None:
    topics = [topic for info in ingested(corpus, tmp_path / "store").sequences() for topic in info.topics]
    pictures = plots = tracks = 0
    for topic in topics:
        described = describe_topic(topic)
        assert described.timing.rows == topic.rows, topic
        assert (described.timing.start_ns, described.timing.end_ns) == (topic.start_ns, topic.end_ns), topic
        for table in (first_rows(topic, 3), last_rows(topic, 3)):
            assert table.num_rows == min(3, topic.rows)
            json_value(table.to_pylist())
            texts = [scalar_text(value, 40) for column in table.columns for value in column]
            assert max(map(len, texts), default=0) < 200
        series = read_series(topic, plot_fields(topic), max_points=500)
        plots += bool(chart_lines(series, width=60, height=8)) if series else 0
        track = read_track(topic)
        tracks += track is not None and len(local_meters(track)) > 0
        row = nearest_row(topic)
        if has_pictures(topic) and row is not None:
            pixels = row_picture(topic, row, size=200)
            assert pixels.ndim == 3
            pictures += 1
    assert len(topics) > 250
    assert pictures >= 35
    assert plots > 60
    assert tracks >= 10
