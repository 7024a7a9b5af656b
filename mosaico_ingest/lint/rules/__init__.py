"""The checks of the lint rules, one module per rule.

Each module defines its check as `CHECK`, or as `CHECKS` if rules share their code. Rules without a module here are checked
while the file is parsed, validated or compiled.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pkgutil import iter_modules

from mosaico_ingest.lint.check import Check

__all__ = ["CHECKS"]


def _checks() -> Iterator[Check]:
    for name in (module.name for module in iter_modules(__path__)):
        module = import_module(f"{__name__}.{name}")
        yield from module.CHECKS if hasattr(module, "CHECKS") else (module.CHECK,)


CHECKS: tuple[Check, ...] = tuple(_checks())
"""The checks of all modules in this package, sorted by the names of the modules."""
