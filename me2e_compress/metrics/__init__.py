"""Scores of driven episodes, independent of any simulator, model or pass."""
