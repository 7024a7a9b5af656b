"""The platform's protocol over the embedded store, so that its clients list, read, query and write here.

Calls come in over Flight, `Store` and `StoreSession` do the work. It never keeps state of its own beyond
open sessions: what was finalized survives it, what was not is gone with it.
"""

from __future__ import annotations

from mosaico_ingest.serve.keys import Keyring
from mosaico_ingest.serve.server import Server, Tls, serve

__all__ = ["Keyring", "Server", "Tls", "serve"]
