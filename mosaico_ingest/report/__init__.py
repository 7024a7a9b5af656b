"""What happened: events while it happens, a report at the end."""
