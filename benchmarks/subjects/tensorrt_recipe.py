"""The recipes that ship with their int8 for TensorRT, as the kept figures are."""

import dataclasses

from me2e_compress.manager import recipe
from me2e_compress.passes import Pass
from me2e_compress.passes.quantize_int8 import QuantizeInt8


def for_tensorrt(name: str) -> tuple[Pass, ...]:
    """Build the passes of a shipped recipe; where one quantizes, it does for TensorRT.

    Raises:
        RecipeError: there is no such recipe.
    """
    return tuple(
        dataclasses.replace(each, target="tensorrt")
        if isinstance(each, QuantizeInt8)
        else each
        for each in recipe.load(name)
    )
