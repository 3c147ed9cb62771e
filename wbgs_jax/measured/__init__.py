"""Received powers that people have measured at many places: read, averaged, interpolated and extrapolated."""
