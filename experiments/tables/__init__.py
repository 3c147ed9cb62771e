"""The tables and figures of the paper, one file each, and the page that holds them: `python -m experiments.tables`."""
