"""Pictures of the pages for the documentation: `./dev screenshots` writes them to docs/images."""

from __future__ import annotations

import io
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from browser import open_browser
from PIL import Image

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.pages.browser import BrowserServer
from mosaico_ingest.pages.run import run_page
from mosaico_ingest.pages.sequence import sequence_page
from mosaico_ingest.report.run import RunReport

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / "docs" / "images"
NAMES = ("run.png", "sequence.png", "browse.png")
WIDTH = 1100
COLORS = 128
JOB = """version: 1
bag: {path: drives/*.mcap}
sequence: {name: "{stem}", metadata: {vehicle: demo-01, place: test circle}}
topics: ["*", "!/camera/image_raw"]
expect:
  on_failure: warn
  recording: {unreadable: 0}
  topics:
    /imu: {gap: {max: 200 ms}}
target: {store: mosaico}
"""
ZSTANDARD = b"\x28\xb5\x2f\xfd"
"""The start of a compressed chunk; without it, the chunk is unreadable."""


def take_screenshots(folder: Path) -> None:
    """Write a picture of each page to a folder: a run with a damaged recording, a sequence, and the list of sequences."""
    with tempfile.TemporaryDirectory() as work, _working_folder(Path(work)):
        report = _run()
        store = Store.open("mosaico", create=False)
        Path("run.html").write_text(run_page(report))
        Path("sequence.html").write_text(sequence_page(store, "morning"))
        server = BrowserServer("mosaico")
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            with open_browser() as browser:
                for name, address, height in (
                    ("run.png", Path("run.html").absolute().as_uri(), 1900),
                    ("sequence.png", Path("sequence.html").absolute().as_uri(), 1850),
                    ("browse.png", server.address, 420),
                ):
                    browser.open(address, width=WIDTH, height=height)
                    _save(browser.screenshot(), folder / name)
        finally:
            server.shutdown()
            thread.join()
            server.close()


def _run() -> RunReport:
    """Ingest the quickstart three times, once with a damaged chunk."""
    drive = (ROOT / "configs" / "quickstart" / "drive.mcap").read_bytes()
    damaged = bytearray(drive)
    at = drive.rindex(ZSTANDARD)
    damaged[at : at + len(ZSTANDARD)] = bytes(len(ZSTANDARD))
    Path("drives").mkdir()
    for name, content in (("morning", drive), ("noon", bytes(damaged)), ("evening", drive)):
        Path(f"drives/{name}.mcap").write_bytes(content)
    Path("job.yaml").write_text(JOB)
    report = api.run(api.compile_job(Path("job.yaml")))
    return report.replace(manifests=(api.used_manifest(Path("job.yaml")),))


def _save(png: bytes, path: Path) -> None:
    """Write a picture with few colors, which is a third as large."""
    Image.open(io.BytesIO(png)).convert("RGB").quantize(COLORS).save(path, optimize=True)


@contextmanager
def _working_folder(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else IMAGES
    target.mkdir(parents=True, exist_ok=True)
    take_screenshots(target)
