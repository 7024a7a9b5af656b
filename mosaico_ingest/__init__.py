"""Declarative ingestion of ROS recordings into typed, queryable Mosaico sequences."""
