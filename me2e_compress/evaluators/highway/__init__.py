"""Closed-loop evaluation in highway-env: world, cameras, runner.

Reading results does not need highway-env; driving needs the extra ``highway``.
"""
