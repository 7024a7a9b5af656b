"""Jobs, validated and built from a manifest or from the arguments of `ROSInjectionConfig`.

The package defines the sections of a job, composes manifests (`extends`, `matrix`) and records the span of every value.
It must not open recordings or destinations.
"""
