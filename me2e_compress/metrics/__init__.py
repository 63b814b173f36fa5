"""Scores of driven episodes, independent of any simulator, model or pass."""

BUDGET_MS = 50.0  # limit of a decision: a frame at 20 Hz
