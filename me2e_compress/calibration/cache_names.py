"""Find a graph's tensors in a cache that was measured before the exact passes.

TensorRT calibrates the file that it parses, and names tensors as that file does. The
graph to be quantized has been through passes: most tensors keep their names, merged and
rewritten ones do not.
"""

import dataclasses
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.review import RangeFinding
from me2e_compress.display import counted
from me2e_compress.errors import FramesError
from me2e_compress.graph import digest, provenance, static_shape
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, maker

_LEAST = 0.5
"""Least share of the needed tensors that a cache of this graph has."""


@dataclasses.dataclass(frozen=True, eq=False)
class SourceNames:
    """What the nodes of a source file make.

    Attributes:
        made: outputs, by the name of the node.
        values: the same, by their own name.
    """

    made: Mapping[str, tuple[ir.Value, ...]]
    values: Mapping[str, ir.Value]

    @classmethod
    def of(cls, source: ir.Model) -> "SourceNames":
        """Note the outputs of every node; all nodes must have names."""
        made = {str(node.name): tuple(node.outputs) for node in source.graph}
        values = {str(each.name): each for outs in made.values() for each in outs}
        return cls(made, values)

    def handed_on(self, origins: Sequence[str]) -> list[ir.Value]:
        """Return what leaves a group of nodes: read by others, or a graph output."""
        group = set(origins)
        return [
            value
            for name in origins
            for value in self.made.get(name, ())
            if value.is_graph_output()
            or any(use.node.name not in group for use in value.uses())
        ]


def taken_from(
    cache: Ranges,
    path: Path,
    model: ir.Model,
    tensors: Sequence[str],
    source: SourceNames,
) -> tuple[Ranges, list[str], tuple[RangeFinding, ...]]:
    """Take the ranges of ``tensors`` from a cache; return what it lacks, and say so.

    ``model`` is the graph after the passes. A tensor is looked up by its name if its
    maker is as it was, else by what the nodes of the source file handed on that the
    maker stands for; then by that of a tensor with the same elements, in front of or
    behind operators that only move them.

    Raises:
        FramesError: the cache is of another graph: it has less than half of the
            tensors.
    """
    values = {str(v.name): v for v in _values(model)}
    looked_up = {name: _found(values[name], cache.tensors, source) for name in tensors}
    names = {name: found for name, found in looked_up.items() if found is not None}
    missing = [name for name in tensors if name not in names]
    if len(names) < _LEAST * len(tensors):
        raise FramesError(
            f"{path}: a cache of another graph: it lacks {missing[0]} and"
            f" {len(missing) - 1} more of {counted(len(tensors), 'tensor')}; it has"
            f" {next(iter(cache.tensors))}"
        )
    bounds = {name: cache.tensors[found] for name, found in names.items()}
    taken = dataclasses.replace(cache, tensors=bounds, model=digest(model))
    renamed = {name: found for name, found in names.items() if name != found}
    return taken, missing, _said(renamed, missing, path)


def _values(model: ir.Model) -> Iterator[ir.Value]:
    yield from model.graph.inputs
    for node in model.graph:
        yield from node.outputs


def _found(value: ir.Value, known: Container[str], source: SourceNames) -> str | None:
    """Return the name in a cache of a tensor with the same elements, if there is one.

    Tensors are visited in a fixed order: itself, then towards the input first.
    """
    waiting, seen = [value], {value}
    while waiting:
        each = waiting.pop(0)
        name = _source_name(each, source)
        if name is not None and name in known:
            return name
        near = _moved(each)
        waiting += [other for other in near if other not in seen]
        seen.update(near)
    return None


def _moved(value: ir.Value) -> list[ir.Value]:
    """Return the tensors that differ from it by one operator that moves elements."""
    node = maker(value, *LAYOUT_OPERATORS)
    near = [] if node is None or node.inputs[0] is None else [node.inputs[0]]
    for use in value.uses():
        moved = use.node.outputs[0]
        if use.idx == 0 and maker(moved, *LAYOUT_OPERATORS) is not None:
            near.append(moved)
    return near


def _source_name(value: ir.Value, source: SourceNames) -> str | None:
    """Return what the source file calls a tensor; None where that is not certain.

    A name alone proves nothing: a convolution that took in a normalization has the name
    of its own output, and what came out of the normalization.
    """
    node, own = value.producer(), str(value.name)
    past = None if node is None else provenance.read(node)
    if node is None or past is None:
        return own
    before = source.values.get(own)
    first = None if before is None else before.producer()
    if first is not None and past.origins == (str(first.name),):
        return own if _fit(before, value) else None
    # a node that stands for several, or was split, or stands for another
    handed = source.handed_on(past.origins)
    if len(handed) != 1 or len(node.outputs) > 1 or _shares(node, past.origins):
        return None
    return str(handed[0].name) if _fit(handed[0], value) else None


def _fit(before: ir.Value | None, value: ir.Value) -> bool:
    """Return whether two tensors may be the same, by their shapes."""
    shapes = None if before is None else static_shape(before), static_shape(value)
    return None in shapes or shapes[0] == shapes[1]


def _shares(node: ir.Node, origins: Sequence[str]) -> bool:
    """Return whether a reader of the node stands for the same nodes of the source."""
    for output in node.outputs:
        for use in output.uses():
            past = provenance.read(use.node)
            if past is not None and set(past.origins) & set(origins):
                return True
    return False


def _said(
    names: Mapping[str, str], missing: Sequence[str], path: Path
) -> tuple[RangeFinding, ...]:
    found = []
    if names:
        pairs = tuple(f"{name} from {other}" for name, other in names.items())
        said = f"{len(names)} taken from a tensor of the same elements"
        found.append(RangeFinding("renamed", "note", said, pairs))
    if missing:
        said = f"{counted(len(missing), 'tensor')} not in {path}"
        advice = "What reads them stays float, as in TensorRT 10"
        found.append(
            RangeFinding("not in cache", "warning", said, tuple(missing), (), advice)
        )
    return tuple(found)
