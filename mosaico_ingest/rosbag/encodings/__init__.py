"""Message encodings other than CDR and ROS 1: schemas as definitions, and single messages as dictionaries.

`table` has one entry per encoding. The entries import their libraries when they are used.
"""
