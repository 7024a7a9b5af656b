"""This file is the whole pipeline in a few functions: load, lint, compile, plan, run, inspect."""
