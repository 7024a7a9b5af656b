"""Every decision about a job, made against the real recording; writes nothing."""
