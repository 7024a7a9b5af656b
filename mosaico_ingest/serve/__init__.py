"""The embedded store as a Mosaico server, which lists, reads, queries and writes sequences over Arrow Flight.

`Store` and `StoreSession` do the work; the server keeps no state except open sessions, which are discarded at shutdown. The
package must not depend on recordings or on the pipeline.
"""

from __future__ import annotations

from mosaico_ingest.serve.guard import Keyring, Limits, responds
from mosaico_ingest.serve.server import Server, Tls, serve

__all__ = ["Keyring", "Limits", "Server", "Tls", "responds", "serve"]
