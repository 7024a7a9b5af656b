"""MCAP files: the reader turns a file into connections, index and message blocks; the writer does the opposite.

The reader uses the index if the file has one, and recovers readable messages otherwise. The package must not depend on the other containers.
"""
