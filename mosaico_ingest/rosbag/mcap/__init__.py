"""The reader of MCAP files: a file in, connections, index and message blocks out.

It reads through the index where the file has one, and recovers what is readable otherwise. It must not depend on the other containers.
"""
