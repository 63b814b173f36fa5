"""The privileged expert: a sampling planner in the Frenet frame of the route.

It teaches the driver; ``models.driver.expert:Expert`` and ``:Blind`` are policies.
"""

from models.driver.expert.blind import Blind
from models.driver.expert.expert_policy import Expert

__all__ = ["Blind", "Expert"]
