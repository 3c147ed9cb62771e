"""Files and objects of other programs, in and out: splat viewers, Sionna RT, DeepMIMO (docs/interchange.md)."""
