"""Faults, and what they happen to."""
