"""Training: the host loop, the jitted step, hooks between epochs, checkpoints and run folders."""

from pathlib import Path

EXAMPLE = Path(__file__).parent / "example"
"""Run folder of the trained field that comes with the package (`python -m tools.example_field` makes it)."""
