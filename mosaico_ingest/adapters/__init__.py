"""Rows in the ROS shape in, rows in the ontology's shape out; knows nothing of bytes."""
