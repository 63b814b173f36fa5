"""Closed loop in highway-env: world, cameras, expert, runner."""
