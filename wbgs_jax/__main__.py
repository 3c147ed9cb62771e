"""`python -m wbgs_jax` is the console script `wbgs-jax`."""

from wbgs_jax.commands.main import main

main()
