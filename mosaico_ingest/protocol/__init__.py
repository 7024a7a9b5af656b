"""The Mosaico protocol: typed requests and responses, and their encoding.

Client (`destinations.server`) and server (`serve`) share the rules for names, the message bodies, actions with their
permissions, and error conditions. The package must not depend on either side. Importing it loads the rules for names only.
"""

from __future__ import annotations

from mosaico_ingest.protocol.names import check_metadata, check_sequence_name, check_topic_name

__all__ = ["check_metadata", "check_sequence_name", "check_topic_name"]
