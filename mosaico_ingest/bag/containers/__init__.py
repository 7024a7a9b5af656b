"""Containers: one file's bytes in, its streams and its messages by block out; never merges, never writes.

`open_part` looks at the first bytes; `mcap`, `ros1` and `sqlite` know one format each, behind `part.Part`.
"""
