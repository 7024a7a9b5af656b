"""HTML pages: the report of a run, a stored sequence, and the list of sequences, each in one self-contained file.

The input is a report or an open store; the output is HTML text. The templates escape every value, a content security
policy permits only the page's own scripts and no network, and control characters are visible. The package must not
depend on the command line.
"""
