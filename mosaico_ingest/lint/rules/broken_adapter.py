"""The rule `broken-adapter`: a Python adapter that cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.job.validation import nearest
from mosaico_ingest.lint.job import (
    Job,
    adapter_references,
    find_module,
    python_reference,
    read_classes,
)
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each Python adapter whose file or class is not what it must be."""
    for place, reference in adapter_references(job):
        python = python_reference(reference)
        if python is None or not job.known(reference):
            continue
        file = job.resolve(python.module) if python.is_file else find_module(python.module, job.folder)
        fault = _fault(file, python.name.partition(".")[0]) if file is not None and file.is_file() else None
        if fault is not None:
            yield Problem(fault[0], job.source.span(place), fault[1])


def _fault(file: Path, name: str) -> tuple[str, str] | None:
    """Return what is wrong with the file and what to do about it."""
    try:
        names = read_classes(file)
    except SyntaxError as error:
        return f"{file}:{error.lineno}: {error.msg}", "mend the file"
    except (OSError, ValueError) as error:
        return f"{file} cannot be read: {error}", "mend the file"
    if name not in names:
        close = nearest(name, names)
        known = ", ".join(known for known, fits in names.items() if fits and known[:1].isupper())
        return f"{file} has no {name}", f"did you mean {close}?" if close else f"it has {known or 'no class'}"
    if not names[name]:
        return f"{name} of {file} is no adapter", "derive it from ROSAdapterBase"
    return None


CHECK = Check("broken-adapter", job=check, reads_files=True)
