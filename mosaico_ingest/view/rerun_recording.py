"""A sequence as a recording of the Rerun viewer: images, clouds, transforms, tracks, maps, plots and logs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from mosaico_ingest.destinations.store.model import SequenceInfo, TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.errors import ViewError, missing_library
from mosaico_ingest.images import color_map
from mosaico_ingest.view.pictures import (
    decode_image,
    grid_pixels,
    has_grid,
    has_images,
    has_points,
    row_codec,
    row_points,
)
from mosaico_ingest.view.series import plot_fields, read_series
from mosaico_ingest.view.texts import has_log, log_lines
from mosaico_ingest.view.tracks import (
    FrameNode,
    frame_trees,
    has_track,
    has_transforms,
    read_edges,
    read_track,
)

TIMELINE = "time"
"""Name of the timeline. The viewer adds a timeline `log_time` of its own, which has the times of this process."""
MAX_POINTS = 100_000
"""Points per scalar series and track; extreme values are kept."""
MAX_PLOTS = 6
"""Topics with a plot of their own in the layout."""
_JPEG_QUALITY = 90
_DIRECT = {b"\xff\xd8\xff": "image/jpeg", b"\x89PNG": "image/png"}
"""Image files that the viewer decodes itself, by their first bytes."""
_CODECS = {"hevc": "H265"}
"""The viewer's name of each codec for which it has another one."""
_AXIS_M = 0.3
"""Length of the axes that show a coordinate frame."""
_LEVELS = {"debug": "DEBUG", "warning": "WARN", "error": "ERROR", "stale": "WARN", "fatal": "CRITICAL"}
"""The viewer's name of each level that is not INFO."""


class ViewedTopic:
    """One topic in the viewer: the kinds of its views, and the rows that the viewer cannot show."""

    def __init__(self, topic: TopicInfo) -> None:
        self.topic = topic
        self.kinds: list[str] = []
        self.frames: dict[str, None] = {}
        """Coordinate frames of the points and positions, in the order of their first row."""
        self.is_constant = True
        """Whether no plotted number changes."""
        self.problems: dict[str, int] = {}
        """Number of rows by the reason why they are not shown."""

    @property
    def path(self) -> str:
        """The path of the entity."""
        return self.topic.name

    def add_problem(self, error: Exception) -> None:
        """Count a row that cannot be shown."""
        self.problems[str(error)] = self.problems.get(str(error), 0) + 1


def send_sequence(
    info: SequenceInfo, *, save: Path | None, start_ns: int | None = None, end_ns: int | None = None
) -> list[ViewedTopic]:
    """Open the viewer with a sequence, or write a `.rrd` file, and return how each topic is shown.

    Topics are read batch by batch, so memory does not depend on the size of the sequence.

    Raises:
        IngestError: The Rerun SDK is not installed.
    """
    rerun = _rerun()
    recording: Any = rerun.RecordingStream("mosaico_ingest", recording_id=info.name)
    if save is not None:
        recording.save(save)
    else:
        recording.spawn()
    sender = _Sender(rerun, recording, Window(start_ns, end_ns))
    viewed = [sender.send(topic) for topic in info.topics]
    recording.send_blueprint(_blueprint(viewed))
    recording.flush()
    return viewed


class _Sender:
    def __init__(self, rerun: Any, recording: Any, window: Window) -> None:  # noqa: ANN401 - modules and classes without stubs
        self._rerun = rerun
        self._recording = recording
        self._window = window

    def send(self, topic: TopicInfo) -> ViewedTopic:
        """Send one topic in every form in which the viewer can show it."""
        viewed = ViewedTopic(topic)
        schema = topic.schema
        if has_images(schema) or has_grid(schema):
            viewed.kinds.append("image")
            self._send_rows(viewed, self._image)
        elif has_points(schema):
            viewed.kinds.append("points")
            self._send_rows(viewed, self._points)
        elif has_transforms(topic):
            viewed.kinds.append("transforms")
            self._send_rows(viewed, self._transforms)
        elif has_log(topic):
            self._send_logs(viewed)
        else:
            if has_track(topic):
                self._send_track(viewed)
            self._send_scalars(viewed)
        return viewed

    def _send_rows(self, viewed: ViewedTopic, log: Any) -> None:  # noqa: ANN401 - a function of a row
        for row in self._rows(viewed.topic):
            self._set_time(row[viewed.topic.schema.names[0]])
            try:
                log(viewed, row)
            except ViewError as error:
                viewed.add_problem(error)

    def _rows(self, topic: TopicInfo) -> Iterator[dict[str, Any]]:
        for batch in scan(topic.segments, topic.schema, self._window):
            for at in range(batch.num_rows):  # one row at a time: a batch of images is large
                yield batch.slice(at, 1).to_pylist()[0]

    def _set_time(self, time_ns: int) -> None:
        self._recording.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"))

    def _image(self, viewed: ViewedTopic, row: Mapping[str, Any]) -> None:
        rerun, path = self._rerun, viewed.path
        data = row["data"]
        ros_format = str(viewed.topic.metadata.get("ros_format", ""))
        if has_grid(viewed.topic.schema):
            self._recording.log(path, rerun.Image(grid_pixels(row)))
            return
        codec = row_codec(viewed.topic, row)
        if codec is not None:
            viewer_codec = getattr(rerun.VideoCodec, _CODECS.get(codec, codec.upper()), None)
            if viewer_codec is None:
                raise ViewError(f"this version of the viewer cannot show {codec} video")
            self._recording.log(path, rerun.VideoStream(viewer_codec, sample=data))
            return
        direct = next((kind for start, kind in _DIRECT.items() if bytes(data[:4]).startswith(start)), None)
        is_color = not any(word in ros_format for word in ("UC1", "FC1", "bayer", "mono16"))
        if "encoding" not in row and direct is not None and is_color:
            self._recording.log(path, rerun.EncodedImage(contents=data, media_type=direct))
            return
        pixels = decode_image(row, ros_format=ros_format)
        self._recording.log(path, rerun.Image(pixels).compress(jpeg_quality=_JPEG_QUALITY))

    def _points(self, viewed: ViewedTopic, row: Mapping[str, Any]) -> None:
        points = row_points(row)
        frame = (row.get("header") or {}).get("frame_id")
        if frame:
            self._attach(viewed, viewed.path, frame)
        shades = points.xyz[:, 2] if points.values is None else points.values
        colors = color_map(shades[np.newaxis].astype(np.float64) + 1e-9)[0] if len(shades) else None
        self._recording.log(viewed.path, self._rerun.Points3D(points.xyz, colors=colors))

    def _attach(self, viewed: ViewedTopic, path: str, frame: str, *, static: bool = False) -> None:
        """Attach an entity to a coordinate frame."""
        name = _frame_name(frame)
        viewed.frames[name] = None
        self._recording.log(path, self._rerun.CoordinateFrame(name), static=static)

    def _transforms(self, viewed: ViewedTopic, row: Mapping[str, Any]) -> None:
        for transform in row.get("transforms", [row]) or ():
            parent, child = (transform["header"] or {}).get("frame_id"), transform["target_frame_id"]
            if not parent or not child:
                viewed.add_problem(ViewError("a transform does not name its frames"))
                continue
            translation, rotation = transform["translation"], transform["rotation"]
            self._recording.log(
                f"{viewed.path}/{_frame_name(child)}",
                self._rerun.Transform3D(
                    translation=[translation[axis] for axis in "xyz"],
                    quaternion=[rotation[axis] for axis in "xyzw"],
                    parent_frame=_frame_name(parent),
                    child_frame=_frame_name(child),
                ),
                self._rerun.TransformAxes3D(_AXIS_M),
            )

    def _send_track(self, viewed: ViewedTopic) -> None:
        track = read_track(viewed.topic, max_points=MAX_POINTS)
        if track is None or not len(track.positions):
            return
        rerun = self._rerun
        index = [self._times(track.times_ns)]
        if track.is_gps:
            viewed.kinds.append("map")
            degrees = track.positions[:, :2]
            line = rerun.GeoLineStrings(lat_lon=[degrees])
            self._recording.log(f"{viewed.path}/track", line, static=True)
            columns = rerun.GeoPoints.columns(positions=degrees)
        else:
            viewed.kinds.append("trajectory")
            if track.frame_id:
                for path in (f"{viewed.path}/track", f"{viewed.path}/position"):
                    self._attach(viewed, path, track.frame_id, static=True)
            self._recording.log(f"{viewed.path}/track", rerun.LineStrips3D([track.positions]), static=True)
            columns = rerun.Points3D.columns(positions=track.positions)
        self._recording.send_columns(f"{viewed.path}/position", index, columns)

    def _send_logs(self, viewed: ViewedTopic) -> None:
        viewed.kinds.append("logs")
        for line in log_lines(viewed.topic):
            if self._window.overlaps(line.time_ns, line.time_ns):
                self._set_time(line.time_ns)
                text = f"[{line.source}] {line.text}" if line.source else line.text
                level = _LEVELS.get(line.level, "INFO")
                self._recording.log(viewed.path, self._rerun.TextLog(text, level=level))

    def _send_scalars(self, viewed: ViewedTopic) -> None:
        fields = plot_fields(viewed.topic)
        if not fields:
            return
        for series in read_series(
            viewed.topic,
            fields,
            max_points=MAX_POINTS,
            start_ns=self._window.start_ns,
            end_ns=self._window.end_ns,
        ):
            finite = np.isfinite(series.values)
            if not finite.any():
                continue
            path = f"{viewed.path}/plot/{series.label}"
            name = f"{series.label} [{series.unit}]" if series.unit else series.label
            self._recording.log(path, self._rerun.SeriesLines(names=name), static=True)
            index = [self._times(series.times_ns[finite])]
            self._recording.send_columns(
                path, index, self._rerun.Scalars.columns(scalars=series.values[finite])
            )
            viewed.is_constant = viewed.is_constant and not np.ptp(series.values[finite])
            if "plot" not in viewed.kinds:
                viewed.kinds.append("plot")

    def _times(self, times_ns: np.ndarray[Any, np.dtype[np.int64]]) -> Any:  # noqa: ANN401 - a class of the SDK, which has no stubs for it
        return self._rerun.TimeColumn(TIMELINE, timestamp=times_ns.astype("datetime64[ns]"))


def _frame_name(frame_id: object) -> str:
    """Return the name of a coordinate frame without the slash with which ROS 1 starts it."""
    return str(frame_id).removeprefix("/")


def _blueprint(viewed: list[ViewedTopic]) -> Any:  # noqa: ANN401 - a class of the SDK, which has no stubs for it
    """Return the layout: spaces and map above, cameras in the middle, plots and logs below."""
    blueprint = import_module("rerun.blueprint")
    by_kind = {
        kind: [each for each in viewed if kind in each.kinds] for kind in ("map", "image", "plot", "logs")
    }
    above = [
        blueprint.Spatial3DView(
            origin="/",
            contents=contents,
            name=frame or "space",
            spatial_information=blueprint.SpatialInformation(frame) if frame else None,
        )
        for frame, contents in spaces(viewed).items()
    ]
    if by_kind["map"]:
        contents = [f"{each.path}/**" for each in by_kind["map"]]
        above.append(blueprint.MapView(origin="/", contents=contents, name="map"))
    cameras = [blueprint.Spatial2DView(origin=each.path, name=each.path) for each in by_kind["image"]]
    below = [
        blueprint.TimeSeriesView(origin=f"{each.path}/plot", name=each.path)
        for each in sorted(by_kind["plot"], key=lambda each: each.is_constant)[:MAX_PLOTS]
    ]
    if by_kind["logs"]:
        contents = [each.path for each in by_kind["logs"]]
        below.append(blueprint.TextLogView(origin="/", contents=contents, name="logs"))
    rows = [
        *([_row(blueprint, above)] if above else []),
        *([blueprint.Grid(*cameras)] if cameras else []),
        *([_row(blueprint, below)] if below else []),
    ]
    time_panel = blueprint.TimePanel(timeline=TIMELINE, state="collapsed")
    return blueprint.Blueprint(blueprint.Vertical(*rows), time_panel, collapse_panels=True)


def _row(blueprint: ModuleType, views: list[Any]) -> Any:  # noqa: ANN401 - a class of the SDK, which has no stubs for it
    """Return views side by side if they fit, otherwise as tabs."""
    return blueprint.Tabs(*views) if len(views) > 3 else blueprint.Horizontal(*views)  # noqa: PLR2004 - views that fit


def spaces(viewed: list[ViewedTopic]) -> dict[str, list[str]]:
    """Return the paths of entities with positions by the frame in which the viewer shows them; "" is no frame.

    The viewer can show entities together only if transforms connect their frames, so each tree of frames has a space.
    """
    edges = [edge for edge in read_edges(each.topic for each in viewed) if edge.parent and edge.child]
    roots = {
        _frame_name(name): _frame_name(tree.name) for tree in frame_trees(edges) for name in _frame_ids(tree)
    }
    spaces: dict[str, list[str]] = {}
    for edge in edges:
        child = _frame_name(edge.child)
        spaces.setdefault(roots[child], []).append(f"{edge.topic}/{child}")
    for each in viewed:
        if not {"points", "trajectory"}.isdisjoint(each.kinds):
            frame = next(iter(each.frames), "")
            spaces.setdefault(roots.get(frame, frame), []).append(f"{each.path}/**")
    return spaces


def _frame_ids(tree: FrameNode) -> list[str]:
    """Return the frames of a tree, which can be deeper than recursion can be."""
    nodes = [tree]
    for node in nodes:  # grows while it is iterated
        nodes += node.children
    return [node.name for node in nodes]


def _rerun() -> Any:  # noqa: ANN401 - a module
    try:
        return import_module("rerun")
    except ImportError as error:
        raise missing_library("The Rerun SDK", "view") from error
