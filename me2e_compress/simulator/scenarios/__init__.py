"""44 scenario types after Bench2Drive's: a layout and an actor script each."""

VARIANTS = 5
"""Routes of each type, as in Bench2Drive's 220."""
