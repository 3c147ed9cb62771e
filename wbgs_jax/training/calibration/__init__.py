"""Calibration of a scene before the first training step: antennas, materials, geometry, array gains, absorption."""
