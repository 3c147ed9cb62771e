"""Scores, baselines, reports and pictures of trained fields."""
