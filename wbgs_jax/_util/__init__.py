"""Utilities of the whole library: errors, files, checks, pytrees, compilation, command lines."""
