"""`python -m wbgs_jax.train` is `wbgs-jax train`."""

from wbgs_jax.commands.train import main, run_command

if __name__ == "__main__":
    run_command(main)
