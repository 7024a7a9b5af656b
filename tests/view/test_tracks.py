"""Tracks: positions of GPS receivers and bodies, thinned evenly, and their local coordinates."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.ontology.registry import OntologyType, builtin_type
from mosaico_ingest.view.tracks import has_track, local_meters, read_track

FIX = OntologyType(
    "Unmodeled",
    pa.struct(
        [
            ("latitude", pa.float64()),
            ("longitude", pa.float64()),
            ("altitude", pa.float64()),
            ("status", pa.struct([("status", pa.int8())])),
        ]
    ),
)
BODY = OntologyType(
    "Unmodeled", pa.struct([("x", pa.float32()), ("y", pa.float32()), ("theta", pa.float32())])
)


def fix(at: int, latitude: float | None, longitude: float, status: int = 0) -> dict[str, Any]:
    columns = {"latitude": latitude, "longitude": longitude, "altitude": 5.0, "status": {"status": status}}
    return {"timestamp_ns": at, **columns}


def test_read_track_of_quickstart_has_latitude_longitude_and_frame(quickstart: Store) -> None:
    track = read_track(quickstart.topic("quickstart_drive", "/gps/fix"))
    assert track is not None
    assert (track.is_gps, track.rows, track.frame_id) == (True, 50, "gps")
    assert track.positions[0] == pytest.approx([45.46, 9.19, 122], abs=0.01)
    meters = local_meters(track)
    assert meters[0].tolist() == [0, 0]
    assert 3 < np.ptp(meters[:, 0]) < 30


def test_read_track_omits_rows_without_fix(make_store: Any) -> None:
    rows = [fix(0, 1, 2), fix(1, None, 2), fix(2, math.nan, 2), fix(3, 3, 4, status=-1), fix(4, 5, 6)]
    track = read_track(make_store({"/t": (FIX, rows)}).topic("made", "t"))
    assert track is not None
    assert track.times_ns.tolist() == [0, 4]
    assert track.positions.tolist() == [[1, 2, 5], [5, 6, 5]]


@pytest.mark.parametrize("max_points", [1, 3, 10, 99, 1000])
def test_read_track_thins_evenly_across_batches(make_store: Any, max_points: int) -> None:
    rows = [fix(at, at / 10, 0) for at in range(100)]
    track = read_track(make_store({"/t": (FIX, rows)}).topic("made", "t"), max_points=max_points)
    assert track is not None
    assert track.rows == 100
    assert track.times_ns.tolist() == list(range(0, 100, -(-100 // max_points)))


def test_read_track_of_planar_body_has_z_zero(make_store: Any) -> None:
    store = make_store({"/t": (BODY, [{"timestamp_ns": 1, "x": 1.0, "y": 2.0, "theta": 0.5}])})
    track = read_track(store.topic("made", "t"))
    assert track is not None
    assert not track.is_gps
    assert track.positions.tolist() == [[1, 2, 0]]
    assert local_meters(track).tolist() == [[1, 2]]


def test_local_meters_crosses_the_date_line(make_store: Any) -> None:
    rows = [fix(0, 0, 179.999), fix(1, 0.001, -179.999)]
    track = read_track(make_store({"/t": (FIX, rows)}).topic("made", "t"))
    assert track is not None
    assert local_meters(track)[1] == pytest.approx([222.39, 111.19], abs=0.1)


@pytest.mark.parametrize(
    ("tag", "expected"),
    [
        *((tag, True) for tag in ("GPS", "Pose", "MotionState", "Transform", "Point3d")),
        *((tag, False) for tag in ("IMU", "FrameTransform", "Lidar", "Vector3d", "RobotPath")),
    ],
)
def test_has_track_by_ontology_type(make_store: Any, tag: str, expected: int) -> None:
    assert has_track(make_store({"/t": (builtin_type(tag), [])}).topic("made", "t")) == expected


def test_read_track_of_topic_without_rows_or_positions(make_store: Any) -> None:
    store = make_store({"/gps": (FIX, []), "/imu": (builtin_type("IMU"), [])})
    track = read_track(store.topic("made", "gps"))
    assert track is not None
    assert track.positions.shape == (0, 3)
    assert local_meters(track).shape == (0, 2)
    assert read_track(store.topic("made", "imu")) is None
