"""The adapters of `std_msgs`, as in the official SDK."""

from mosaico_ingest.adapters import HeaderAdapter

__all__ = ["HeaderAdapter"]
