"""What training finds out about a scene before gradient steps: antennas, materials, geometry, obstacles."""
