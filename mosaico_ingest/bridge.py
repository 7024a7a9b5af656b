"""This file finds the adapter for a topic: override, loaded, entry point, built-in, unmodeled."""
