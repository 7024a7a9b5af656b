"""This file spells the platform's Flight actions, bodies and metadata keys once, for client and server."""
