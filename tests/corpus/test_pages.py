"""Pages of real recordings: images, depth, point clouds, tracks, logs and custom types, in a real browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser import CHROMIUM, open_browser

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.pages.sequence import sequence_page

RECORDINGS = {
    "roboto-ai__robologs-ros-actions/tiny_svo.bag": {"cameras", "tracks", "plots", "logs"},
    "ctu-vras__ros-utils/compressedDepth.bag": {"cameras"},
    "swri-robotics__bag-reader-java/PointCloud2.bag": {"clouds"},
    "cra-ros-pkg__robot_localization/test1.bag": {"tracks", "plots"},
    "foxglove__rosbag/example.bag": {"tracks", "plots", "frames", "logs"},
    "rerun-io__rerun/rosbag2_2025_09_10-13_03_56_0.mcap": {"cameras", "clouds", "plots", "logs"},
}
"""The sections that the page of each recording has."""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize("recording", RECORDINGS)
def test_page_of_real_recording_has_its_sections_and_no_error(
    corpus: Path, tmp_path: Path, recording: str
) -> None:
    manifest = tmp_path / "job.yaml"
    manifest.write_text(
        f"version: 1\nbag: {{path: {corpus / recording}}}\nsequence: {{name: drive}}\n"
        "on_error: {message: ignore, topic: ignore}\ntarget: {store: store}\n"
    )
    api.run(api.compile_job(manifest))
    page = tmp_path / "drive.html"
    page.write_text(sequence_page(Store.open(tmp_path / "store", create=False), "drive"))
    with open_browser() as browser:
        browser.open(page.as_uri(), height=3000)
        ids = set(browser.evaluate("[...document.querySelectorAll('h2')].map(each => each.id)"))
        assert RECORDINGS[recording] <= ids
        assert browser.console == []
        assert [url for url in browser.requests if not url.startswith("data:image/")] == [page.as_uri()]
        assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")
        broken = "[...document.images].filter(each => !each.complete || !each.naturalWidth).length"
        assert browser.evaluate(broken) == 0
