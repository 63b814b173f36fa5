"""The privileged expert: a sampling planner in the Frenet frame of the route."""

from me2e_compress.evaluators.highway.expert.expert_policy import (
    Expert,
    ExpertDecision,
    Memory,
    decide,
)
from me2e_compress.evaluators.highway.expert.speed_limits import ceiling

__all__ = ["Expert", "ExpertDecision", "Memory", "ceiling", "decide"]
