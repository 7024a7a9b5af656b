"""The readers of ROS 1 bags, versions 2.0 and 1.2: a file in, connections, index and message blocks out.

They recover the readable messages of unindexed or damaged bags. They must not depend on the other containers.
"""
