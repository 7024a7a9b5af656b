"""The mapping language: the text of an adapter file in, an adapter that computes on Arrow columns out.

A mapping is parsed, checked against both schemas and compiled to column operations; no text is evaluated as Python.
The package must not depend on recordings or destinations.
"""
