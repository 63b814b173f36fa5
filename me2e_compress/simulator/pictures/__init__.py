"""Pictures of a driven route: a moment, a strip, an animation, two drives at once."""
