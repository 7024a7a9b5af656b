"""`WriteBuffer`: it keeps the order of batches, limits its bytes, and passes errors of the writer on."""

from __future__ import annotations

import signal
import threading
import time
from unittest.mock import Mock

import pyarrow as pa
import pytest

from mosaico_ingest.errors import SinkError
from mosaico_ingest.pipeline.write_buffer import WriteBuffer


def batch(value: int, rows: int = 4) -> pa.RecordBatch:
    return pa.record_batch({"timestamp_ns": pa.array([value] * rows, pa.int64())})


class Writer:
    def __init__(self, *, fail_on: int | None = None, delay_s: float = 0.0) -> None:
        self.seen: list[int] = []
        self.fail_on = fail_on
        self.delay_s = delay_s

    def write(self, batch: pa.RecordBatch) -> None:
        time.sleep(self.delay_s)
        value = batch.column(0)[0].as_py()
        if value == self.fail_on:
            raise SinkError("disk full")
        self.seen.append(value)


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("mosaico-ingest")]


@pytest.mark.promise("write-buffer")
def test_buffer_writes_all_batches_in_order() -> None:
    writer = Writer()
    with WriteBuffer(max_bytes=100) as buffer:
        for value in range(50):
            buffer.put(writer, batch(value))
    assert writer.seen == list(range(50))
    assert not threads()


def test_buffer_writes_batch_larger_than_its_limit() -> None:
    writer = Writer()
    with WriteBuffer(max_bytes=1) as buffer:
        for value in range(3):
            buffer.put(writer, batch(value))
    assert writer.seen == [0, 1, 2]


def test_buffer_raises_error_of_the_writer() -> None:
    writer = Writer(fail_on=3)
    with pytest.raises(SinkError, match="disk full"), WriteBuffer(max_bytes=100) as buffer:
        for value in range(1000):
            buffer.put(writer, batch(value))
    assert writer.seen == [0, 1, 2]
    assert not threads()


def test_buffer_writes_accepted_batches_after_an_error_of_the_caller() -> None:
    writer = Writer(delay_s=0.001)
    with pytest.raises(KeyError), WriteBuffer(max_bytes=10_000) as buffer:
        for value in range(10):
            buffer.put(writer, batch(value))
        raise KeyError
    assert writer.seen == list(range(10))
    assert not threads()


@pytest.mark.promise("write-buffer")
def test_put_waits_while_the_buffer_is_full() -> None:
    writer = Writer(delay_s=0.02)
    with WriteBuffer(max_bytes=batch(0).nbytes * 2) as buffer:
        for value in range(6):
            buffer.put(writer, batch(value))
            assert value - len(writer.seen) <= 3
    assert len(writer.seen) == 6


def test_interrupt_waits_for_a_stuck_writer_up_to_the_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.pipeline.write_buffer._INTERRUPTED_S", 0.1)
    writer = Writer(delay_s=0.5)
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), WriteBuffer(max_bytes=1000) as buffer:
        for value in range(3):
            buffer.put(writer, batch(value))
        raise KeyboardInterrupt
    assert time.monotonic() - start < 0.45
    buffer._thread.join()
    assert writer.seen == [0]


@pytest.mark.usefixtures("interruptible")
def test_interrupt_while_closing_writes_all_accepted_batches() -> None:
    writer = Writer(delay_s=0.2)
    main = threading.main_thread().ident
    assert main is not None
    interrupt = threading.Timer(0.1, signal.pthread_kill, (main, signal.SIGINT))
    with pytest.raises(KeyboardInterrupt), WriteBuffer(max_bytes=64) as buffer:
        for value in range(3):
            buffer.put(writer, batch(value))
        interrupt.start()
    interrupt.join()
    assert writer.seen == [0, 1, 2]
    assert not threads()


def test_buffer_delays_small_batches() -> None:
    writer = Writer()
    with WriteBuffer(max_bytes=1 << 30) as buffer:
        for value in range(5):
            buffer.put(writer, batch(value))
        time.sleep(0.05)
        assert not writer.seen
    assert writer.seen == [0, 1, 2, 3, 4]


def test_put_on_full_buffer_wakes_the_writer() -> None:
    writer = Writer()
    almost = batch(0, 100_000)  # 0.8 MB, below the size that wakes the writer
    with WriteBuffer(max_bytes=1 << 20) as buffer:
        buffer.put(writer, almost)
        buffer.put(writer, almost)
    assert writer.seen == [0, 0]


def test_buffer_writes_small_amounts_without_a_thread() -> None:
    writer = Writer()
    with WriteBuffer(max_bytes=1 << 30) as buffer:
        buffer.put(writer, batch(1))
        assert not threads()
    assert writer.seen == [1]


def test_buffer_without_a_thread_raises_error_of_the_writer() -> None:
    with pytest.raises(SinkError, match="disk full"), WriteBuffer(max_bytes=1 << 30) as buffer:
        buffer.put(Writer(fail_on=1), batch(1))


def test_interrupt_while_writing_the_rest_is_raised_despite_an_earlier_error() -> None:
    interrupted = Mock(write=Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt), WriteBuffer(max_bytes=1 << 30) as buffer:
        buffer.put(interrupted, batch(1))
        raise SinkError("earlier")
