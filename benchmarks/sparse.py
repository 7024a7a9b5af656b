"""A recording of any size whose bytes a web server synthesizes by range: an index, a small topic and huge chunks of zeros."""

from __future__ import annotations

import re
import struct
import threading
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

MAGIC = b"\x89MCAP0\r\n"
START_NS = 1_700_000_000_000_000_000
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, DATA_END = 11, 15
SMALL, HUGE = 1, 2
"""The channels of the two topics."""
PAYLOAD = b"\x00\x01\x00\x00" + struct.pack("<d", 1.5)


@dataclass
class Sparse:
    """Pieces of content by offset; all other bytes are zeros."""

    size: int = 0
    pieces: dict[int, bytes] = field(default_factory=dict[int, bytes])
    sent_bytes: int = 0

    def append(self, content: bytes) -> None:
        self.pieces[self.size] = content
        self.size += len(content)

    def read(self, start: int, end: int) -> bytes:
        content = bytearray(end - start)
        offsets = list(self.pieces)
        for offset in offsets[max(0, bisect_right(offsets, start) - 1) :]:
            if offset >= end:
                break
            piece = self.pieces[offset]
            first, last = max(start, offset), min(end, offset + len(piece))
            if first < last:
                content[first - start : last - start] = piece[first - offset : last - offset]
        return bytes(content)


def record(kind: int, body: bytes, *, missing: int = 0) -> bytes:
    """Return a record; `missing` is the number of its bytes that follow."""
    return struct.pack("<BQ", kind, len(body) + missing) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def mapping(values: Mapping[int, int]) -> bytes:
    return struct.pack("<I", len(values) * 10) + b"".join(
        struct.pack("<HQ", *item) for item in values.items()
    )


def connections() -> bytes:
    definition = b"float64 data"
    schema = (
        struct.pack("<H", 1) + text("made/msg/Number") + text("ros2msg") + struct.pack("<I", len(definition))
    )
    channels = (
        record(CHANNEL, struct.pack("<HH", channel, 1) + text(topic) + text("cdr") + struct.pack("<I", 0))
        for channel, topic in ((SMALL, "/small"), (HUGE, "/huge"))
    )
    return record(SCHEMA, schema + definition) + b"".join(channels)


def recording(chunks: int, chunk_bytes: int) -> Sparse:
    """Return a recording with a message of `/small` and one of `/huge` per step, in chunks of their own."""
    file, indexes = Sparse(), list[bytes]()
    file.append(MAGIC + record(HEADER, text("ros2") + text("sparse")) + connections())
    for step in range(chunks):
        time_ns = START_NS + step * 10**9
        for channel in (SMALL, HUGE):
            payload = PAYLOAD if channel == SMALL else b""
            missing = chunk_bytes if channel == HUGE else 0
            message = struct.pack("<HIQQ", channel, step, time_ns, time_ns) + payload
            records = record(MESSAGE, message, missing=missing)
            span, size = struct.pack("<QQ", time_ns, time_ns), len(records) + missing
            start = file.size
            body = span + struct.pack("<QI", size, 0) + text("") + struct.pack("<Q", size) + records
            file.append(record(CHUNK, body, missing=missing))
            file.size += missing
            index_start = file.size
            entry = struct.pack("<HIQQ", channel, 16, time_ns, 0)
            file.append(record(MESSAGE_INDEX, entry))
            indexes.append(
                record(
                    CHUNK_INDEX,
                    span
                    + struct.pack("<QQ", start, index_start - start)
                    + mapping({channel: index_start})
                    + struct.pack("<Q", file.size - index_start)
                    + text("")
                    + struct.pack("<QQ", size, size),
                )
            )
    file.append(record(DATA_END, struct.pack("<I", 0)))
    summary_start = file.size
    end_ns = START_NS + (chunks - 1) * 10**9
    counts = struct.pack("<QHIIIIQQ", 2 * chunks, 1, 2, 0, 0, 2 * chunks, START_NS, end_ns)
    statistics = record(STATISTICS, counts + mapping({SMALL: chunks, HUGE: chunks}))
    footer = record(FOOTER, struct.pack("<QQI", summary_start, 0, 0))
    file.append(connections() + b"".join(indexes) + statistics + footer + MAGIC)
    return file


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    file: Sparse

    def log_message(self, *_: object) -> None:
        """Print nothing."""

    def do_GET(self) -> None:
        file = self.file
        match = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        start, end = (int(match[1]), min(int(match[2]) + 1, file.size)) if match else (0, file.size)
        self.send_response(206 if match else 200)
        self.send_header("Content-Length", str(end - start))
        self.send_header("ETag", '"1"')
        self.send_header("Accept-Ranges", "bytes")
        if match:
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{file.size}")
        self.end_headers()
        if self.command == "GET":
            file.sent_bytes += end - start
            self.wfile.write(file.read(start, end))

    do_HEAD = do_GET  # noqa: N815 - the name of the base class


@contextmanager
def served(file: Sparse) -> Iterator[str]:
    """Serve a recording and yield its URL."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"file": file}))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/drive.mcap"
    finally:
        server.shutdown()
        server.server_close()
