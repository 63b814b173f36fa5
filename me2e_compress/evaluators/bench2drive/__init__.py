"""Reads the results of real Bench2Drive and CARLA leaderboard runs.

One record becomes one `Episode`: what the simulator scored stands in `Episode.given`,
the motion of the ego comes from the agent's ``metric_info.json``. Nothing of CARLA is
imported.
"""
