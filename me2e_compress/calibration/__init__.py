"""Calibration: recorded frames, probes, observers, and the ranges that follow."""
