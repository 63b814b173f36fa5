"""Which pipelines a graph of the short test is judged by: each in its turn."""

import onnx

from tests.fuzz.exact.pipelines import Pipeline, for_graph

TAKEN = 7
"""Pipelines for each graph."""


def some_for(model: onnx.ModelProto, seed: int) -> tuple[Pipeline, ...]:
    """Choose every n-th pipeline, beginning with another for every seed.

    The recipe ``exact`` is among them always: it is what users run.
    """
    found = [each for each in for_graph(model, seed) if "onnxsim" not in each.text]
    step = max(1, len(found) // TAKEN)
    chosen = found[seed % step :: step]
    whole = [each for each in found if each.label == "recipe exact"]
    return tuple(dict.fromkeys((*chosen, *whole)))
