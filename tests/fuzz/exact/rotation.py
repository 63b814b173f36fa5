"""Which pipelines a graph is judged by: each in its turn."""

import onnx

from tests.fuzz.exact.pipelines import RECIPES, SLOW, Pipeline, for_graph

SHORT, LONG = 7, 8
"""Pipelines for each graph of the short test, and of a night."""


def some_for(
    model: onnx.ModelProto, seed: int, taken: int = SHORT
) -> tuple[Pipeline, ...]:
    """Choose every n-th pipeline, beginning with another for every seed.

    The recipes that ship are among them always: they are what users run.

    Args:
        model: the graph.
        seed: of the graph.
        taken: about how many besides the recipes.
    """
    found = for_graph(model, seed)
    whole = {f"recipe {name}" for name in RECIPES[: None if taken > SHORT else 1]}
    turns = [each for each in found if each.label not in (*whole, *SLOW)]
    step = max(1, len(turns) // taken)
    always = [each for each in found if each.label in whole]
    return (*turns[seed % step :: step], *always)
