"""Scores of episodes: they never see a simulator, a model or a pass."""
