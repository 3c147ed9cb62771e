"""Experiments and measurements; they use public names only."""
