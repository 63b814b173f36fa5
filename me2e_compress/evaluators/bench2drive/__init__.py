"""Readers of results of real Bench2Drive and CARLA leaderboard runs.

One record becomes one `Episode`: the simulator's own scores are in `Episode.given`, the
ego's motion comes from the agent's ``metric_info.json``. CARLA is not imported.
"""
