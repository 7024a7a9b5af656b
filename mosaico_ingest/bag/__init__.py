"""Recordings: paths in, channels with their message types and messages in batches out; never changes a recording.

`recording.open_recording` is the way in. `containers/` knows one file format each, `discover` which files a path
stands for, `merge` and `gather` the order in time, `types` what a message is made of.
"""
