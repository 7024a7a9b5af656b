"""This file reads what is stored back, every page and all rows against their checksums, and holds it against the catalog."""

from __future__ import annotations

from collections.abc import Iterator

import pyarrow as pa
import pyarrow.parquet as pq

from mosaico_ingest.frozen import frozen
from mosaico_ingest.store.content import ContentHash, column_makers
from mosaico_ingest.store.files import opened
from mosaico_ingest.store.model import SegmentInfo, SequenceInfo, TopicInfo
from mosaico_ingest.store.segment import time_span

__all__ = ["Checked", "verify"]


@frozen
class Checked:
    """One segment that was read to its end, and what is wrong with it."""

    topic: str
    segment: SegmentInfo
    problem: str | None


def verify(info: SequenceInfo) -> Iterator[Checked]:
    """Read every segment of a sequence; a damaged page, a missing file and rows the catalog does not know are problems."""
    for topic in info.topics:
        for segment in topic.segments:
            yield Checked(topic.name, segment, _problem(topic, segment))


def _problem(topic: TopicInfo, segment: SegmentInfo) -> str | None:
    try:
        with opened(segment.path, page_checksum_verification=True) as file:
            if not file.schema_arrow.equals(topic.schema):
                return "its columns are not those of its topic"
            content = ContentHash(column_makers(file.schema_arrow))
            found = (segment.path.stat().st_size, *_rows_and_span(file, content))
    except FileNotFoundError:
        return "is not there"
    except (OSError, pa.ArrowException) as error:
        return str(error).partition("\n")[0]
    wanted = (segment.stored_bytes, segment.rows, segment.start_ns, segment.end_ns)
    if found != wanted:
        form = "{} bytes, {} rows in [{}, {}]"
        return f"the catalog says {form.format(*wanted)}, the file has {form.format(*found)}"
    if segment.checksum not in {None, content.hexdigest()}:
        return f"its rows have the checksum {content.hexdigest()}, those that were written {segment.checksum}"
    return None


def _rows_and_span(file: pq.ParquetFile, content: ContentHash) -> tuple[int, int, int]:
    """Return how many rows the file really gives, after adding them to `content`, and the span its row groups state."""
    rows = 0
    for batch in file.iter_batches(batch_size=1 << 12):
        content.add(batch)
        rows += batch.num_rows
    spans = [time_span(file.metadata, group) for group in range(file.num_row_groups)]
    return rows, min((low for low, _ in spans), default=0), max((high for _, high in spans), default=0)
