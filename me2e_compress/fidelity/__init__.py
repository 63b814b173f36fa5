"""Two graphs on the same frames: signal to noise of every output, plans in metres."""
