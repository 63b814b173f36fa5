"""What the extras of the package bring, looked for before any work."""

from importlib import util

from me2e_compress.errors import MissingExtraError

ROAD = ("highway_env", "cv2", "jinja2", "matplotlib", "scipy")
"""Packages of the extra ``highway``."""
ZOO = ("torch",)
"""Packages of the extra ``zoo``."""


def are_there(packages: tuple[str, ...]) -> bool:
    """Return whether all packages are installed."""
    return all(util.find_spec(name) is not None for name in packages)


def need_closed_loop(what: str) -> None:
    """Go on if the extra ``highway`` is installed.

    Raises:
        MissingExtraError: it is not, and ``what`` needs it.
    """
    if not are_there(ROAD):
        raise MissingExtraError(what, "highway")
