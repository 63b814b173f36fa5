"""Actor scripts: generators that are resumed at every decision (10 Hz).

They are triggered by where the ego is and when it will arrive, never by the clock, so
that they happen to a slow driver as to a fast one. Several follow scenario_runner's
`SyncArrival`: the actor adapts until the ego is close, then keeps its way.
"""
