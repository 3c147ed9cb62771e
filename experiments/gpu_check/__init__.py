"""Is everything well on a GPU, and how fast is it? `python -m experiments.gpu_check`, `make gpu-check`."""
