"""Stored data for people: statistics, pictures, tracks and rows of the topics of a store.

The package reads topics of the embedded store and returns plain values and NumPy arrays; the command line, notebooks and
pages render them. It must not depend on recordings, on a terminal, or at import time on an optional library.
"""
