"""Message definitions: `.msg` text in, parsed types with their dependencies and hashes out.

The package contains the parser, the registry, and the types of each ROS distro and of some public packages. It must not
depend on containers.
"""
