"""Metadata of sequences and topics: its sources in recordings, and its validation against JSON Schemas.

Input: jobs and opened recordings. Output: jobs with their final metadata, and findings with locations in the files that
state the metadata. The package depends only on jobs and recordings, so lint, plans and runs share it.
"""
