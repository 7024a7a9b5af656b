"""Messages that could not be ingested go in and lie in an MCAP file, each with its reason, until they are replayed."""
