"""Generator of scene files (`wbgs_jax.data.schema`) with NVIDIA Sionna RT. See data_gen/README.md."""
