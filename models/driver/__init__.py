"""Training of the driver: its data and its losses."""
