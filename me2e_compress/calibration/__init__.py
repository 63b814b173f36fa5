"""Calibration: recorded frames, probes, observers and ranges."""
