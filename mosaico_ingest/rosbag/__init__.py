"""Recordings: paths or URLs in, connections with their definitions and message tasks in order of log time out.

The package reads MCAP files, SQLite files and ROS 1 bags, including damaged ones, and never changes a recording. It must
not depend on adapters, destinations or the pipeline.
"""
