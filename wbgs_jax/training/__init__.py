"""The host loop, the jitted step, the host controls between epochs, checkpoints and run folders."""
