"""Closed loop in highway-env: world, cameras, expert, runner.

Results are read without highway-env; driving needs the extra ``highway``.
"""
