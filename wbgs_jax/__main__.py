"""`python -m wbgs_jax` is the console script `wbgs-jax`."""

from wbgs_jax.cli import main

main()
