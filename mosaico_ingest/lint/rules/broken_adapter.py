"""The check of `broken-adapter`: a Python adapter that cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.findings import nearest
from mosaico_ingest.lint.check import (
    Check,
    Job,
    Problem,
    adapter_references,
    find_module,
    python_reference,
    read_classes,
)


def check(job: Job) -> Iterator[Problem]:
    """Report Python adapters whose file cannot be parsed or whose class cannot be an adapter."""
    for path, reference in adapter_references(job):
        python = python_reference(reference)
        if python is None or not job.is_expanded(reference):
            continue
        file = job.resolve(python.module) if python.is_file else find_module(python.module, job.folder)
        if file is not None and file.is_file():
            for message, hint in _problems(file, python.name.partition(".")[0]):
                yield Problem(message, job.source.span(path), hint)


def _problems(file: Path, name: str) -> Iterator[tuple[str, str]]:
    try:
        names = read_classes(file)
    except SyntaxError as error:
        yield f"{file}:{error.lineno}: {error.msg}", "fix the Python file"
        return
    except (OSError, ValueError) as error:
        yield f"{file} cannot be read: {error}", "fix the Python file"
        return
    if name not in names:
        close = nearest(name, names)
        classes = ", ".join(name for name, usable in names.items() if usable and name[:1].isupper())
        hint = f"did you mean {close}?" if close else f"the file defines {classes or 'no class'}"
        yield f"{file} does not define {name}", hint
    elif not names[name]:
        yield f"{name} in {file} is not an adapter", "derive it from ROSAdapterBase"


CHECK = Check("broken-adapter", job=check, reads_files=True)
