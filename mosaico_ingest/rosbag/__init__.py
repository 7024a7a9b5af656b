"""Recordings: paths in, connections with their message definitions and message blocks out. Never changes a recording."""
