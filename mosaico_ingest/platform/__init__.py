"""A Mosaico server as a destination."""
