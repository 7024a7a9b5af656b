"""The readers of ROS 1 bags, versions 2.0 and 1.2."""
