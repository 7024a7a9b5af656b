"""The checks of the lint rules, one module per rule.

Each module defines its check as `CHECK`. Rules without a module here are checked while the file is parsed, validated or
compiled.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from mosaico_ingest.lint.check import Check

__all__ = ["CHECKS"]

CHECKS: tuple[Check, ...] = tuple(
    import_module(f"{__name__}.{module.name}").CHECK for module in iter_modules(__path__)
)
"""The checks of all modules in this package, sorted by name."""
