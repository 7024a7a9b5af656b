"""The run of one recording: plan, read, decode, adapt, write, verify, report."""
