"""`python -m wbgs_jax.eval` is `wbgs-jax eval`."""

from wbgs_jax.commands.evaluate import main, run_command

if __name__ == "__main__":
    run_command(main)
