"""One file a container format: MCAP, SQLite (rosbag2), ROS 1."""
