"""`python -m experiments.bench`: what this machine does, as a JSON file with provenance."""
