"""Training: the host loop, the jitted step, hooks between epochs, checkpoints and run folders."""
