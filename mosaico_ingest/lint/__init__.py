"""Judges manifests, adapters and message definitions without opening a recording or a socket."""
