"""Import and export of other programs' files and objects: splat viewers, Sionna RT, DeepMIMO (docs/interchange.md)."""
