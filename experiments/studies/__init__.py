"""Measurements that one page quotes: each a command of its own, with a result file of its name."""
