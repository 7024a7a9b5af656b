"""Typed models and their exact Arrow columns; knows nothing of ROS."""
