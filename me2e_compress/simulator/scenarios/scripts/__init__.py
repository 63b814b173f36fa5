"""Actor scripts: generators that are resumed at every decision (10 Hz).

Traffic is drawn before the route begins. What waits for the ego, as in scenario_runner,
is triggered by the ego's position and a delay that is drawn.
"""
