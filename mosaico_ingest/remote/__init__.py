"""What lies behind a URL instead of on a disk: paths that look like `pathlib`'s, and the file systems that serve them.

Nothing here imports `pyarrow.fs` before a URL is really reached for; a job of local files never does.
"""

from __future__ import annotations

from mosaico_ingest.remote.path import AnyPath, RemotePath, as_path, is_url

__all__ = ["AnyPath", "RemotePath", "as_path", "is_url"]
