"""The privileged expert: a sampling planner in the Frenet frame of the route.

It teaches the driver; as a policy it is ``models.driver.expert:Expert``.
"""

from models.driver.expert.expert_policy import Expert

__all__ = ["Expert"]
