"""Scores: they see recorded values and episodes, never a simulator or a pass."""
