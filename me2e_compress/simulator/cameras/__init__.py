"""Six pinhole cameras over the painted road."""
