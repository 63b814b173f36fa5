"""Every pipeline that promises the same outputs: passes, options, recipes, orders."""

import contextlib
import dataclasses
import functools
import random
import sys
from collections.abc import Iterator

import onnx
import pytest

from me2e_compress.manager import recipe
from me2e_compress.passes import PASSES, Pass, flatten_matmul, hoist_linear, work
from tests.fuzz.exact.running import open_sizes

NUMBERS = {"bytes_per_node": (0, 1_000_000)}
"""Options that are numbers, and what is tried besides their defaults."""

DIALECTS = ("me2e", "tensorrt", "derryhub", "autoware")
"""Plugin libraries that a graph is translated to."""

SLOW = ("fold-with-onnxsim",)
"""Passes that start a process: only a few graphs are given to them."""

ORDERS = (
    "fuse-operators, expand-operators",
    "fuse-operators, attach-bodies",
    "fuse-operators, fuse-kernels, attach-bodies",
    "fuse-kernels, expand-operators, eliminate-redundant",
    "fuse-basic, hoist-linear, fold-constants, eliminate-redundant",
    "hoist-linear, eliminate-redundant, hoist-linear, fuse-basic",
)
"""Passes one behind the other, besides the recipes."""

PREFIX = "dear work: "
"""What a pipeline begins with that is run where rewriting pays nearly always."""
DEAR = (
    "hoist-linear",
    "fold-constants{bytes_per_node=1000000}, hoist-linear, fuse-basic,"
    " eliminate-redundant",
    "hoist-linear, flatten-matmul, eliminate-redundant",
)
PRICES = ("MACS_PER_NODE", "MOVED_BYTES_PER_NODE", "SMALL_PRODUCTS_PER_NODE")

SHORT, LONG = 7, 8
"""Pipelines for each graph of the short test, and of a night."""


@functools.cache
def recipe_text(name: str) -> str:
    """Write a recipe that ships as a pipeline."""
    return recipe.to_text(recipe.load(name))


@functools.cache
def pipelines() -> tuple[str, ...]:
    """List what graphs are judged by in turn."""
    single = [text for name in PASSES.names() for text in _variants(name)]
    return (*single, *ORDERS, *(f"{PREFIX}{text}" for text in DEAR))


def _variants(name: str) -> Iterator[str]:
    """Write an exact pass with its defaults, then with each option changed."""
    found: type[Pass] = PASSES.get(name)
    if not found.exact or name in (*SLOW, "fix-shapes"):
        return
    if name == "translate-plugins":
        yield from (f"{name}{{dialect={each}}}" for each in DIALECTS)
        return
    yield name
    for field in dataclasses.fields(found):
        if isinstance(field.default, bool):
            yield f"{name}{{{field.name}={str(not field.default).lower()}}}"
        for number in NUMBERS.get(field.name, ()):
            yield f"{name}{{{field.name}={number}}}"


def some_for(model: onnx.ModelProto, seed: int, taken: int = SHORT) -> tuple[str, ...]:
    """Choose every n-th pipeline, beginning with another for every seed.

    The recipe ``exact`` is among them always: it is what users run; ``fused`` by night.

    Args:
        model: the graph; open dimensions get sizes of its own.
        seed: of the graph, which draws an order of passes too.
        taken: about how many besides the recipes.
    """
    found, always = list(pipelines()), [recipe_text("exact")]
    if taken > SHORT:
        always.append(recipe_text("fused"))
    sizes = open_sizes(seed, model)
    if len(sizes) > 1:
        fixed = f"fix-shapes{{dims={{N={sizes[0]}}}}}"
        found += [fixed, f"{fixed},{always[0].partition(',')[2]}"]
    draw = random.Random(seed)
    names = ("fold-constants", "eliminate-redundant", "hoist-linear", "fuse-basic")
    found.append(", ".join(draw.choices(names, k=draw.randint(2, 5))))
    step = max(1, len(found) // taken)
    return (*found[seed % step :: step], *always)


def has_modules(model: onnx.ModelProto) -> bool:
    """Say whether nodes have paths, by which a map gives them modules."""
    return any(node.name.startswith("/") for node in model.graph.node)


METHODS = ("max-min", "percentile:99.9", "mse")
SCHEMES = ("full", "full", "feature-ext", "prediction")
RULES = ("paper", "paper", "safe")
EACH = 2
"""How many ways a graph is quantized for each target."""


def int8_ways(model: onnx.ModelProto, seed: int) -> Iterator[str]:
    """Draw how a graph is quantized; schemes go by modules."""
    draw, named = random.Random(seed), has_modules(model)
    for target in ("tensorrt", "onnxruntime", "lowered"):
        for _ in range(EACH):
            options = {
                "scheme": draw.choice(SCHEMES) if named else "full",
                "method": draw.choice(METHODS),
                "rules": draw.choice(RULES),
                "target": "onnxruntime" if target == "onnxruntime" else "tensorrt",
            }
            given = ", ".join(f"{key}={value}" for key, value in options.items())
            lowered = ", lower-int8" if target == "lowered" else ""
            yield f"quantize-int8{{{given}}}{lowered}"


@contextlib.contextmanager
def dear_work() -> Iterator[None]:
    """Let work count a thousandfold for a while.

    A product moves only where that pays, and in a graph of a few rows it seldom does.
    What a rewrite computes must not depend on its price.
    """
    homes = [
        module
        for name, module in list(sys.modules.items())
        if name in (work.__name__, flatten_matmul.__name__)
        or name.startswith(f"{hoist_linear.__name__}.")
    ]
    priced = [(home, name) for home in homes for name in PRICES if hasattr(home, name)]
    assert priced
    with pytest.MonkeyPatch.context() as patch:
        for home, name in priced:
            patch.setattr(home, name, getattr(home, name) / 1000)
        yield
