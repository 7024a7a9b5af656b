"""Executors: the configurations of many recordings in, one report per recording out.

An executor decides where `mosaico_ingest.pipeline` runs: in this process, in a pool of processes, or on a Ray cluster.
It must not decide how a recording is ingested, and it must not write to a terminal.
"""
