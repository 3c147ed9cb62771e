"""Measurements on top of `wbgs_jax`: the paper's tables and figures, series of single changes, and what a machine can do.

* `runner.py` runs jobs (`python -m experiments.runner`): `jobs.py` says what a job is, `profiles.py` how large, `variants.py`
  what it changes, `settings.py` puts that together, `execute.py` trains and scores, `results.py` keeps what comes out.
* `tables/`: a file a table or figure of the paper (`python -m experiments.tables`), which shows the results that there are.
* `series/`: one change at a time (`--only choices`, `tuning`, `wave_choices`).
* `studies/`: what one page quotes, a command each.
* `results/`: a file of JSON lines a profile, a line a job; `result_table.py` makes one table of them.
* `bench/`: this machine (`python -m experiments.bench`); `gpu_check/`: a GPU.
"""
