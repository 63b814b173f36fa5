"""Six pinhole cameras over the painted road: images, and what each pixel shows."""
