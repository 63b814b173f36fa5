"""The recipes that ship with their int8 for TensorRT, as the kept figures are."""

from me2e_compress.manager import recipe
from me2e_compress.passes import Pass


def for_tensorrt(name: str) -> tuple[Pass, ...]:
    """Build the passes of a shipped recipe; where one quantizes, it does for TensorRT.

    Raises:
        RecipeError: there is no such recipe.
    """
    return tuple(
        each.with_options({"target": "tensorrt"}) if each.quantizes else each
        for each in recipe.load(name)
    )
