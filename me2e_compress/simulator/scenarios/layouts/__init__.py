"""Roads: every layout lays the network and sets the ego's route."""
