"""The host loop, the jitted step, the hooks between epochs, checkpoints and run folders."""
