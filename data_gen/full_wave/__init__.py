"""A ground truth without ray tracing: Maxwell's equations on a grid (FDTD, openEMS) in a small furnished cabin at 1 to 1.5
GHz."""
