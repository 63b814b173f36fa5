"""The calibration frames, what is observed on them, and the ranges that follow."""
