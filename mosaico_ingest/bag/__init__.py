"""Recordings: what is in them, their message types, and their messages in batches; never writes."""
