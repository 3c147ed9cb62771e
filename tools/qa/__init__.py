"""Accounts of the tests: what faults were tried, which lines are reached, which errors are noticed, whose files are read."""
