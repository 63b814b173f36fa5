"""The driving contract: observations, answers and the latency of a decision."""
