"""The simulated world on highway-env: routes, traffic, scenarios, cameras.

It knows no policy and no model: at each frame it is given a `Control`. Routes are read
without highway-env; movement and rendering need the extra ``highway``.
"""
