"""A job as the user wrote it: YAML with positions in, a strict frozen model out; opens no recording."""
