"""This file runs a plan: recording, decode, adapt, sink. It decides nothing."""
