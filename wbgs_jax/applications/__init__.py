"""Applications of a trained field: localisation of transmitters, choice of beams, placement of antennas and reflectors."""
