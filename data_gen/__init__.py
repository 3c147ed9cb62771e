"""Generator of scene files (`wbgs_jax.data.scene_file`) with NVIDIA Sionna RT. See data_gen/README.md."""
