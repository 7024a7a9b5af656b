"""Destinations: the sequence, its topics and Arrow batches in, a committed sequence out.

`base` defines the protocols of a destination; each subpackage implements them for one kind. The package must not depend
on recordings, message definitions or adapters.
"""
