"""The reader of MCAP files."""
