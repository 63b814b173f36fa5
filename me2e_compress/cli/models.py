"""Models as users name them: a file, or the name of one that ships."""

from pathlib import Path

from me2e_compress.errors import GraphError
from me2e_compress.zoo.shipped import SHIPPED, shipped


def model_path(text: str, beside: Path = Path()) -> Path:
    """Give the file that a word means; an existing file wins.

    Args:
        text: a path, or a name in `SHIPPED`.
        beside: the folder that the path is relative to.

    Raises:
        GraphError: neither, or the shipped file is missing or altered.
    """
    path = beside / text
    if path.is_file():
        return path
    if text in SHIPPED:
        return shipped(text)
    raise GraphError(f"{text}: no such file; models that ship: {', '.join(SHIPPED)}")
