"""The package `bridges` of the official SDK since 0.7; it contains `ros`.

It must not contain code of its own.
"""
