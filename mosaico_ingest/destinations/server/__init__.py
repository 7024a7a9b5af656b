"""A Mosaico server as a destination: Arrow batches in, uploads over Arrow Flight out.

The package is the client side of `mosaico_ingest.protocol`. It must not depend on recordings or on the embedded store.
"""
