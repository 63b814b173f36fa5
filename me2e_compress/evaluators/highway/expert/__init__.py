"""The privileged expert: a sampling planner on the Frenet frame of the route."""

from me2e_compress.evaluators.highway.expert.deciding import (
    ExpertDecision,
    Memory,
    decide,
)
from me2e_compress.evaluators.highway.expert.policy import Expert
from me2e_compress.evaluators.highway.expert.speed import ceiling

__all__ = ["Expert", "ExpertDecision", "Memory", "ceiling", "decide"]
