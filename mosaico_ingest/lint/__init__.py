"""The linter: manifests, adapter files and `.msg` files in, findings and safe fixes out.

The package must not open recordings or connections, must not run Python adapters, and writes files only for `--fix`.
"""
