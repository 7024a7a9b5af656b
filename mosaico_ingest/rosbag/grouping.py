"""Groups of split files without a `metadata.yaml`: which files are the splits of one recording (`bag.group`)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise

from msgspec import Struct

from mosaico_ingest.containers import ACTIVE_SUFFIX, RECORDING_NAME
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.remote import AnyPath

NumberOf = Callable[[str], "Mapping[str, str | int | float] | None"]
"""Returns the values of a file name without its suffix, with the number of the split as `split`; None for other names."""
_NUMBERED = re.compile(r"(?P<stem>.+?)(?P<date>_\d{4}(?:-\d\d){5})?_(?P<split>\d{1,9})")
"""The name of a split: rosbag2 appends the number to the name of the recording, ROS 1 the date of the split, too."""


class SplitGroup(Struct, frozen=True):
    """The files of one recording, in the order of their numbers."""

    files: tuple[AnyPath, ...]
    stem: str | None = None
    """The name of the recording without number and suffix; None for a file that is not a split."""


class _Split(Struct, frozen=True):
    file: AnyPath
    stem: str
    key: tuple[object, ...]
    number: int
    date: str = ""


def group_splits(files: Sequence[AnyPath], number_of: NumberOf | None = None) -> tuple[SplitGroup, ...]:
    """Return the recordings that files belong to, in the order of their first files.

    Without `number_of`, files of one folder are the splits of one recording if their names differ only in the number after
    the last `_`, the numbers start at 0 and no number occurs twice. Files of ROS 1 with a date before the number belong to
    the recording that the latest number 0 started.
    """
    by_key: dict[tuple[object, ...], list[_Split]] = {}
    for file in files:
        split = _split(file, number_of)
        if split is not None:
            by_key.setdefault(split.key, []).append(split)
    groups = [
        group for splits in by_key.values() for group in _groups(splits, any_start=number_of is not None)
    ]
    group_of = {file: group for group in groups for file in group.files}
    return tuple(dict.fromkeys(group_of.get(file) or SplitGroup((file,)) for file in files))


def has_split_number(name: str) -> bool:
    """Return whether a file name ends with a number, as the names of splits do."""
    return _NUMBERED.fullmatch(_without_suffix(name)[0]) is not None


def numbering_gaps(
    files: Sequence[AnyPath], number_of: NumberOf | None = None, *, from_zero: bool = False
) -> Iterator[Finding]:
    """Yield a finding for each gap in the numbers of the splits of a recording, with `from_zero` also before the first."""
    by_key: dict[tuple[object, ...], list[_Split]] = {}
    for file in files:
        split = _split(file, number_of)
        if split is not None:
            by_key.setdefault(split.key, []).append(split)
    for splits in by_key.values() if all(_split(file, number_of) for file in files) else ():
        numbers = sorted({split.number for split in splits})
        before = [-1, *numbers] if from_zero else numbers
        for last, following in pairwise(before):
            if following > last + 1:
                missing = str(last + 1) if following == last + 2 else f"{last + 1} to {following - 1}"
                yield Finding(
                    "split-gap",
                    Severity.WARNING,
                    f"{splits[0].stem}: no file has the number {missing}",
                    help="restore the missing splits; their messages are missing",
                )


def _split(file: AnyPath, number_of: NumberOf | None) -> _Split | None:
    bare, suffix = _without_suffix(file.name)
    folder, kind = str(file.parent), suffix.lower()
    if number_of is not None:
        values = number_of(file.name.removesuffix(ACTIVE_SUFFIX)) or number_of(bare)
        if values is None:
            return None
        others = tuple((key, value) for key, value in values.items() if key != "split")
        stem = "_".join(str(value) for _, value in others)
        return _Split(file, stem or file.parent.name, (folder, kind, *others), int(values["split"]))
    match = _NUMBERED.fullmatch(bare)
    if match is None:
        return None
    key = (folder, kind, match["stem"], match["date"] is None)
    return _Split(file, match["stem"], key, int(match["split"]), match["date"] or "")


def _without_suffix(name: str) -> tuple[str, str]:
    """Return a file name without its suffix, and the suffix."""
    name = name.removesuffix(ACTIVE_SUFFIX)
    suffix = RECORDING_NAME.search(name)
    return (name, "") if suffix is None else (name[: suffix.start()], suffix[0])


def _groups(splits: Sequence[_Split], *, any_start: bool) -> Iterator[SplitGroup]:
    """Yield the recordings of splits that have the same name apart from their numbers and dates."""
    recordings: list[list[_Split]] = []
    for split in sorted(splits, key=lambda split: (split.date, split.number)):
        if not recordings or (split.date and split.number <= recordings[-1][-1].number):
            recordings.append([])
        recordings[-1].append(split)
    for recording in recordings:
        numbers = [split.number for split in recording]
        is_numbered = len(set(numbers)) == len(numbers) and (any_start or numbers[0] == 0)
        if is_numbered and (any_start or len(numbers) > 1):
            name = recording[0].stem + recording[0].date
            yield SplitGroup(tuple(split.file for split in recording), name)
