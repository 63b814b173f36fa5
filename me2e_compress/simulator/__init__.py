"""The world that is driven in, on highway-env: routes, traffic, scenarios, cameras.

It knows no policy and no model: at each frame it is given a `Control`. Routes are read
without highway-env; what moves and what is seen needs the extra ``highway``.
"""
