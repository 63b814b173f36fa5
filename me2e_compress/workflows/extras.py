"""What the extras of the package bring, looked for before any work."""

from importlib import util

from me2e_compress.errors import MissingExtraError

PACKAGES = {
    "highway": ("highway_env", "cv2", "jinja2", "matplotlib", "scipy"),
    "logs": ("cv2",),
    "zoo": ("torch",),
}
"""What each extra brings, as it is imported."""


def missing_extra(extras: str) -> str:
    """Return the extras, parted by commas, if a package of them is not installed.

    Empty, if all are.
    """
    needed = [name for extra in extras.split(",") for name in PACKAGES.get(extra, ())]
    return "" if all(map(util.find_spec, needed)) else extras


def need_closed_loop(what: str) -> None:
    """Go on if the extra ``highway`` is installed.

    Raises:
        MissingExtraError: it is not, and ``what`` needs it.
    """
    need_extra("highway", what)


def need_extra(extra: str, what: str) -> None:
    """Go on if an extra is installed.

    Raises:
        MissingExtraError: it is not, and ``what`` needs it.
    """
    if missing_extra(extra):
        raise MissingExtraError(what, extra)
