"""Use cases beside a run: status, watching, replay, inspection, adapter tools, drafts of manifests.

Each function receives paths or configurations and returns data for the command line to print. The package must not write
to a terminal.
"""
