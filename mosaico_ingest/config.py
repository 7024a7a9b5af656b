"""This file is the job as a Python value: what a script builds by hand, a manifest compiles to."""
