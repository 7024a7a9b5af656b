"""Who runs the plans: in this process, in several, on Ray."""
