"""One addition of each kind to me2e-compress."""
