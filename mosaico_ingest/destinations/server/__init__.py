"""A Mosaico server as a destination: batches in, DoPut streams out; it never sees a message or a recording."""
