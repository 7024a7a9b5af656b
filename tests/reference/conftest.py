"""The project of the tests of the reference."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from sample_project import clean_registries, write_project


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A user's folder with modules and definitions; it is the current directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    modules = set(sys.modules)
    write_project(tmp_path)
    with clean_registries():
        yield tmp_path
    for name in ("my_ontology", "my_adapter", "setup_registry"):
        if name not in modules:
            sys.modules.pop(name, None)
