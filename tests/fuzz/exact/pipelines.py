"""Every pipeline that promises the same outputs: passes, options, recipes, orders."""

import dataclasses
import functools
import random
from collections.abc import Iterator

import onnx

from me2e_compress import recipe
from me2e_compress.passes import PASSES, Pass
from tests.fuzz.exact.prices import PREFIX
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
    "fuse-basic, hoist-linear, fold-constants, eliminate-redundant",
    "hoist-linear, eliminate-redundant, hoist-linear, fuse-basic",
)
"""Passes one behind the other, besides the recipes."""

DEAR = (
    "hoist-linear",
    "hoist-linear{bytes_per_node=1000000}",
    "fold-constants{bytes_per_node=1000000}, hoist-linear{bytes_per_node=1000000},"
    " fuse-basic, eliminate-redundant",
)
"""Run once more where rewriting pays nearly always."""

RECIPES = ("exact", "fused")


@dataclasses.dataclass(frozen=True)
class Pipeline:
    """Passes as text, and what a table calls them: orders are drawn, sizes differ."""

    label: str
    text: str


@functools.cache
def pipelines() -> tuple[Pipeline, ...]:
    """List what every graph is judged by."""
    single = [text for name in PASSES.names() for text in _variants(name)]
    whole = [Pipeline(f"recipe {name}", recipe_text(name)) for name in RECIPES]
    dear = [f"{PREFIX}{text}" for text in DEAR]
    return (*(Pipeline(text, text) for text in (*single, *ORDERS, *dear)), *whole)


def recipe_text(name: str) -> str:
    """Write a recipe that ships as a pipeline."""
    return recipe.to_text(recipe.load(name))


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


def for_graph(model: onnx.ModelProto, seed: int) -> tuple[Pipeline, ...]:
    """List the pipelines for one graph: sizes of its own, and an order of its own."""
    found = list(pipelines())
    sizes = open_sizes(seed, model)
    if len(sizes) > 1:
        fixed = f"fix-shapes{{dims={{N={sizes[0]}}}}}"
        found.append(Pipeline("fix-shapes", fixed))
        after = recipe_text("exact").partition(",")[2]
        found.append(Pipeline("fix-shapes, recipe exact", f"{fixed},{after}"))
    draw = random.Random(seed)
    names = ("fold-constants", "eliminate-redundant", "hoist-linear", "fuse-basic")
    drawn = ", ".join(draw.choices(names, k=draw.randint(2, 5)))
    found.append(Pipeline("a drawn order", drawn))
    if seed % 200 == 199:
        found += [Pipeline(name, name) for name in SLOW]
    return tuple(found)
