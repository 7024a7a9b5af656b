"""The command line: the only part with a terminal."""
