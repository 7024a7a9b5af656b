"""The platform's protocol, spelled once for client and server: names, bodies, actions, keys, conditions.

`names` says what a sequence, a topic and a metadata key may be called; `bodies` is what travels; `actions` is the
calls, with the permission each needs; `codec` is how bodies become bytes; `keys` is API keys; `conditions` is
what can go wrong, as Flight tells it. Importing the package imports the rules for names only.
"""

from __future__ import annotations

from mosaico_ingest.protocol.names import check_metadata, check_sequence_name, check_topic_name

__all__ = ["check_metadata", "check_sequence_name", "check_topic_name"]
