"""Judges job manifests, adapter files and `.msg` files without opening a recording or a socket; writes nothing but fixes."""
