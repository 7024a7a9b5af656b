"""Use cases beside a run: status, watching, replay, inspection, adapter tools, drafts of manifests."""
