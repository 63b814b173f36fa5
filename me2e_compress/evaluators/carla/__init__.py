"""Agents for a real CARLA leaderboard: equation 4 around any agent, and our graph.

Nothing of CARLA or of the leaderboard is imported before an agent is set up.
"""
