"""The embedded store: a SQLite catalog over Parquet segments."""
