"""The permission of adapters in Python: the only code that a job can run.

The environment variable `MOSAICO_NO_PYTHON`, which `ingest --no-python` sets, refuses them for the process and the
processes that it starts; the manifest key `adapters.python` refuses them for one job.
"""

from __future__ import annotations

import os

NO_PYTHON = "MOSAICO_NO_PYTHON"
"""The environment variable that refuses adapters in Python, unless it is empty or `0`."""


def is_python_allowed() -> bool:
    """Return whether this process may run adapters in Python."""
    return os.environ.get(NO_PYTHON, "") in {"", "0"}


def is_python_reference(reference: object) -> bool:
    """Return whether a value of `adapters` is a class, `module:Class` or `file.py:Class`."""
    module, colon, name = str(reference).rpartition(":")
    return isinstance(reference, type) or bool(colon and module and name)


def python_refusal(reference: str) -> tuple[str, str]:
    """Return the message and the hint for a reference to an adapter in Python that is refused."""
    if is_python_allowed():
        return (
            f"{reference} is Python code, which adapters.python refuses",
            "write it as YAML, or allow Python",
        )
    return f"{reference} is Python code, which --no-python refuses", "write it as YAML, or allow Python"
