"""Closed-loop evaluation in highway-env: world, cameras, expert, runner.

Reading results does not need highway-env; driving needs the extra ``highway``.
"""
