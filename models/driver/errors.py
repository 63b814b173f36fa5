"""What training raises on purpose."""

from me2e_compress.base.errors import Me2eError


class TrainingError(Me2eError):
    """A driver cannot be trained as asked."""
