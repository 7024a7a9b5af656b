"""The adapters of `builtin_interfaces`, as in the official SDK."""

from mosaico_ingest.adapters import DurationAdapter, TimeAdapter

__all__ = ["DurationAdapter", "TimeAdapter"]
