"""Errors for optional libraries that are not installed."""

from __future__ import annotations

from mosaico_ingest.errors import IngestError

__all__ = ["missing_library"]


def missing_library(library: str, extra: str) -> IngestError:
    """Return the error for a library that the extra `extra` of this package installs."""
    return IngestError(f"{library} is not installed", hint=f"pip install 'mosaico-ingest[{extra}]'")
