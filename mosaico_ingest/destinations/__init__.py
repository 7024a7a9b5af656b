"""Where sequences go: batches in, committed sequences out. Knows no recordings and no messages."""
