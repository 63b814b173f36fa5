"""Models as users name them: a file, or the name of one that ships."""

from pathlib import Path

from me2e_compress.errors import GraphError
from me2e_compress.zoo.shipped import SHIPPED, shipped


def model_path(text: str) -> Path:
    """Give the file that a word of the command line means; an existing file wins.

    Args:
        text: a path, or a name in `SHIPPED`.

    Raises:
        GraphError: neither, or the shipped file is missing or altered.
    """
    path = Path(text)
    if path.is_file():
        return path
    if text in SHIPPED:
        return shipped(text)
    raise GraphError(f"{text}: no such file; models that ship: {', '.join(SHIPPED)}")
