"""What to do: the types of a job, its manifest, and its configuration. Opens no recording."""
