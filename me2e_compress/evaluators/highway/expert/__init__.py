"""The privileged expert: a sampling planner in the Frenet frame of the route."""
