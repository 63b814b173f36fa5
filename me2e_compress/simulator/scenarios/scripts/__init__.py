"""Actor scripts: generators that are resumed at every decision (10 Hz).

They are triggered by the ego's position and arrival time, never by the clock, so that a
slow driver meets them as a fast one does. Several follow scenario_runner's
`SyncArrival`: the actor adapts until the ego is close, then keeps its motion.
"""
