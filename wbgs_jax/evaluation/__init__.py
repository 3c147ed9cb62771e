"""Scores, baselines and reports of trained fields."""
