"""Antenna arrays, element patterns, frames, and what engineers read from a channel."""
