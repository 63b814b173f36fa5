"""What a graph must look like for the program that will run it."""

import dataclasses
from collections.abc import Callable

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import RecipeError
from me2e_compress.quantization.plan import KeptFloat, QuantPlan
from me2e_compress.targets import (
    onnxruntime,
    tensorrt,
)


@dataclasses.dataclass(frozen=True)
class Target:
    """How int8 is written for one program.

    Attributes:
        name: what recipes and the command line call it.
        tensors: names the activations whose ranges ``place`` needs.
        place: gives a copy of a float graph in which a plan's nodes are int8.
        kept_float: lists those that stay float in that copy, and why.
    """

    name: str
    tensors: Callable[[QuantPlan, ir.Model], tuple[str, ...]]
    place: Callable[[ir.Model, QuantPlan, Ranges], ir.Model]
    kept_float: Callable[[QuantPlan, ir.Model], tuple[KeptFloat, ...]]


TARGETS: dict[str, Target] = {
    each.name: each
    for each in (
        Target("tensorrt", tensorrt.tensors, tensorrt.place, tensorrt.kept_float),
        Target(
            "onnxruntime",
            onnxruntime.tensors,
            onnxruntime.place,
            onnxruntime.kept_float,
        ),
    )
}


def target_named(name: str) -> Target:
    """Give a target by its name.

    Raises:
        RecipeError: there is no such target.
    """
    if name not in TARGETS:
        raise RecipeError(f"no target {name}; there are {', '.join(TARGETS)}")
    return TARGETS[name]
