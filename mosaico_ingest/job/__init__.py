"""Jobs: a manifest or the arguments of `ROSInjectionConfig` in, a validated job out.

The package defines the sections of a job, composes manifests (`extends`, `matrix`) and knows the location of every value.
It must not open recordings or destinations.
"""
