"""What a trained field is for: to locate transmitters, to choose beams, to place antennas."""
