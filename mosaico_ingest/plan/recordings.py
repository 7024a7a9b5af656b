"""This file finds the recordings a manifest names, and names what they become; it looks at paths, never inside."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from datetime import datetime, timezone
from difflib import get_close_matches
from glob import has_magic

from mosaico_ingest.bag.containers.magics import RECORDING_NAME
from mosaico_ingest.errors import ManifestError, NothingMatched
from mosaico_ingest.frozen import frozen
from mosaico_ingest.manifest.load import LoadedManifest
from mosaico_ingest.manifest.placeholders import PLACEHOLDERS, Placeholder, placeholders_in
from mosaico_ingest.remote.path import AnyPath, RemotePath, without_options

__all__ = ["Recording", "find_recordings", "sequence_name"]

_REFUSED = re.compile(r"[^A-Za-z0-9_-]+")


@frozen
class Recording:
    """One recording: its parts, and its position (from 1) among those of the job."""

    paths: tuple[AnyPath, ...]
    index: int

    @property
    def main(self) -> AnyPath:
        """The path it is named after; a rosbag2 directory for its metadata.yaml."""
        first = self.paths[0]
        return first.parent if first.name == "metadata.yaml" else first


def find_recordings(loaded: LoadedManifest) -> tuple[Recording, ...]:
    """Return what `bag.path` names: a list is one recording, a glob one for each match.

    Raises:
        NothingMatched: A file is not there, or a glob matches no recording.
    """
    path = loaded.manifest.bag.path
    if isinstance(path, str):
        matches = _matches(loaded, path, ("bag", "path"))
        return tuple(Recording((match,), index) for index, match in enumerate(matches, 1))
    parts = [part for i, item in enumerate(path) for part in _matches(loaded, item, ("bag", "path", i))]
    return (Recording(tuple(dict.fromkeys(parts)), 1),)


def sequence_name(loaded: LoadedManifest, recording: Recording) -> str:
    """Fill in the placeholders of `sequence.name`; in what they stand for, `_` replaces what no name may have.

    Raises:
        ManifestError: There is no such placeholder.
    """
    template = loaded.manifest.sequence.name
    for placeholder in reversed(list(placeholders_in(template))):
        if not placeholder.known:
            raise ManifestError(
                f"unknown placeholder {template[placeholder.start : placeholder.end]} in sequence.name",
                where=loaded.where("sequence", "name"),
                hint=f"the placeholders are {', '.join(f'{{{name}}}' for name in PLACEHOLDERS)}, and {{index:03}}",
            )
        filled = _fill(placeholder, recording)
        template = template[: placeholder.start] + filled + template[placeholder.end :]
    return template


def _fill(placeholder: Placeholder, recording: Recording) -> str:
    main = recording.main
    if placeholder.name == "index":
        return f"{recording.index:{placeholder.width}}"
    if placeholder.name == "date":
        changed = datetime.fromtimestamp(main.stat().st_mtime, tz=timezone.utc)
        return f"{changed:%Y-%m-%d}"
    texts = {
        "stem": RECORDING_NAME.sub("", main.name),
        "name": main.name,
        "parent": main.resolve().parent.name,
    }
    return _REFUSED.sub("_", texts[placeholder.name]).strip("_")


def _matches(loaded: LoadedManifest, pattern: str, place: tuple[str | int, ...]) -> list[AnyPath]:
    """Return the file or directory `pattern` names, or the recordings it matches, sorted."""
    path = loaded.locate(pattern, *place)
    if path.exists():
        return [path]
    where = loaded.where(*place)
    if not has_magic(without_options(pattern)):
        raise NothingMatched(f"no such file or directory: {path}", where=where, hint=_nearby(path))
    found: list[AnyPath] = sorted(_glob(path))
    recordings = [match for match in found if _is_recording(match)]
    if not recordings:
        only = f"; it matches {len(found)} other files" if found else ""
        raise NothingMatched(f"no recording matches {path}{only}", where=where, hint=_nearby(path))
    return recordings


def _glob(path: AnyPath) -> Iterator[AnyPath]:
    """Yield what a pattern matches; what is hidden, as copying programs leave it, only where the pattern has such a name."""
    found: Iterator[tuple[AnyPath, str]]
    if isinstance(path, RemotePath):
        above = next(parent for parent in path.above if not has_magic(parent.key))
        pattern = path.key.removeprefix(above.key)
        found = ((match, match.key.removeprefix(above.key)) for match in above.glob(pattern))
    else:
        fixed = next(parent for parent in path.parents if not has_magic(str(parent)))
        # Beside other characters `**` is `*`, as behind URLs; Python before 3.13 refuses it there.
        parts = (
            part if part == "**" else re.sub(r"\*+", "*", part) for part in path.relative_to(fixed).parts
        )
        pattern = "/".join(parts)
        found = ((match, match.relative_to(fixed).as_posix()) for match in fixed.glob(pattern))
    yield from (match for match, below in found if _is_hidden(pattern) or not _is_hidden(below))


def _is_hidden(path: str) -> bool:
    return any(part.startswith(".") for part in path.split("/"))


def _is_recording(path: AnyPath) -> bool:
    if path.is_file():
        return RECORDING_NAME.search(path.name) is not None
    return path.is_dir() and ((path / "metadata.yaml").is_file() or _any_recording(_listed(path)))


def _listed(folder: AnyPath) -> list[AnyPath]:
    try:
        return list(folder.iterdir())
    except OSError:  # what a pattern meets on its way need not be ours to read
        return []


def _any_recording(paths: Iterable[AnyPath]) -> bool:
    return any(RECORDING_NAME.search(path.name) for path in paths)


def _nearby(path: AnyPath) -> str:
    """Say what is there instead: the part of the path that exists, and the nearest name in it."""
    folder = path.parent
    while not folder.is_dir() and folder != folder.parent:
        path, folder = folder, folder.parent
    names = sorted(entry.name for entry in _listed(folder))
    close = get_close_matches(path.name, names, n=1, cutoff=0.5)
    if close:
        return f"{folder} has {close[0]!r}"
    recordings = [name for name in names if RECORDING_NAME.search(name)]
    return f"{folder} has {', '.join(recordings[:5]) or 'no recording'}"
