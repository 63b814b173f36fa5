"""Shrink a graph while its verdict stays of the same kind.

Delta debugging over the message: outputs are dropped, then ranges of nodes (what others
read of them becomes an input, or a constant of its value), then weights and names are
made plain. What no longer runs is no candidate.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy.typing as npt
import onnx
from onnx import helper, numpy_helper

from tests.fuzz.exact.running import RefusedError, Runner, drawn_inputs, open_sizes
from tests.fuzz.exact.shrinking_bodies import plain_constants, smaller_bodies

IsAlike = Callable[[onnx.ModelProto], bool]

MOST_TRIALS = 250
"""A shrinking ends after so many candidates."""


@dataclasses.dataclass
class Shrinker:
    """One shrinking.

    Attributes:
        is_alike: says whether a candidate shows what the whole showed.
        trials: how many candidates it was asked about.
    """

    is_alike: IsAlike
    trials: int = 0

    def keeps(self, candidate: onnx.ModelProto) -> bool:
        if self.trials >= MOST_TRIALS:
            return False
        self.trials += 1
        return self.is_alike(candidate)

    def first(
        self, model: onnx.ModelProto, candidates: Iterator[onnx.ModelProto]
    ) -> onnx.ModelProto:
        """Take every candidate that is alike, one on top of the other."""
        for each in candidates:
            if self.keeps(each):
                return each
        return model


def shrink(model: onnx.ModelProto, is_alike: IsAlike) -> onnx.ModelProto:
    """Return a smaller graph of which the same can be said."""
    run = Shrinker(is_alike)
    best = onnx.ModelProto.FromString(model.SerializeToString())
    before = -1
    while before != best.ByteSize() and run.trials < MOST_TRIALS:
        before = best.ByteSize()
        best = _fewer_outputs(run, best)
        best = _earlier_ends(run, best)
        best = _fewer_nodes(run, best)
        best = _fewer_in_bodies(run, best)
        best = _simpler(run, best)
    return best


def _fewer_outputs(run: Shrinker, model: onnx.ModelProto) -> onnx.ModelProto:
    for each in list(model.graph.output):
        if len(model.graph.output) < 2:
            break
        kept = [one.name for one in model.graph.output if one.name != each.name]
        model = run.first(model, iter([_pruned(model, kept)]))
    return model


def _earlier_ends(run: Shrinker, model: onnx.ModelProto) -> onnx.ModelProto:
    """Give the earliest value alone that shows it, in the place of all outputs."""
    names = [node.output[0] for node in model.graph.node if node.output]
    known = _values(model, [name for name in names if name])
    if known is None or len(model.graph.node) < 2:
        return model
    return run.first(model, _ended(model, known))


def _ended(
    model: onnx.ModelProto, known: Mapping[str, npt.NDArray[Any]]
) -> Iterator[onnx.ModelProto]:
    for name, array in known.items():
        copy = onnx.ModelProto.FromString(model.SerializeToString())
        kind = helper.np_dtype_to_tensor_dtype(array.dtype)
        del copy.graph.output[:]
        port = helper.make_tensor_value_info(name, kind, array.shape)
        copy.graph.output.append(port)
        smaller = _pruned(copy, [name])
        if len(smaller.graph.node) < len(model.graph.node):
            yield smaller


def _fewer_nodes(run: Shrinker, model: onnx.ModelProto) -> onnx.ModelProto:
    """Cut out ranges of nodes, long ones first."""
    length = len(model.graph.node) // 2
    while length:
        start = 0
        while start < len(model.graph.node):
            smaller = run.first(model, _without(model, start, start + length))
            start += 0 if smaller is not model else length
            model = smaller
        length //= 2
    return model


def _without(model: onnx.ModelProto, start: int, end: int) -> Iterator[onnx.ModelProto]:
    """Yield the graph without some nodes: bypassed, fed, or their values stored."""
    gone = model.graph.node[start:end]
    if len(gone) == 1 and len(gone[0].output) == 1:
        yield from _bypassed(model, start)
    known = _values(model, [name for node in gone for name in node.output if name])
    if known is None:
        return
    for stored in (False, True):
        copy = onnx.ModelProto.FromString(model.SerializeToString())
        del copy.graph.node[start:end]
        read = _read(copy)
        given = {each.name for each in copy.graph.output}
        for name, array in known.items():
            if name not in read and name not in given:
                continue
            if stored:
                copy.graph.initializer.append(numpy_helper.from_array(array, name))
            else:
                kind = helper.np_dtype_to_tensor_dtype(array.dtype)
                port = helper.make_tensor_value_info(name, kind, array.shape)
                copy.graph.input.append(port)
        kept = [name for name in _names(copy) if name not in known]
        if kept:
            yield _pruned(copy, kept)


def _names(model: onnx.ModelProto) -> list[str]:
    return [each.name for each in model.graph.output]


def _bypassed(model: onnx.ModelProto, at: int) -> Iterator[onnx.ModelProto]:
    """Yield the graph in which readers of a node read one of its inputs instead."""
    node = model.graph.node[at]
    for source in dict.fromkeys(node.input):
        if not source or node.output[0] in _names(model):
            continue
        copy = onnx.ModelProto.FromString(model.SerializeToString())
        del copy.graph.node[at]
        for other in copy.graph.node:
            for index, name in enumerate(other.input):
                if name == node.output[0]:
                    other.input[index] = source
        yield _pruned(copy, _names(copy))


def _pruned(model: onnx.ModelProto, outputs: Sequence[str]) -> onnx.ModelProto:
    """Keep what these outputs need."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    ports = {each.name: each for each in model.graph.output}
    del copy.graph.output[:]
    copy.graph.output.extend(ports[name] for name in outputs if name in ports)
    needed = set(outputs)
    kept = []
    for node in reversed(model.graph.node):
        if needed & set(node.output):
            kept.append(node)
            needed.update(_read_by(node))
    del copy.graph.node[:]
    copy.graph.node.extend(reversed(kept))
    for field in (copy.graph.input, copy.graph.initializer):
        used = [each for each in field if each.name in needed]
        del field[:]
        field.extend(used)  # type: ignore[arg-type]
    return copy


def _read_by(node: onnx.NodeProto) -> set[str]:
    found = set(node.input)
    for attribute in node.attribute:
        if attribute.type == onnx.AttributeProto.GRAPH:
            for each in attribute.g.node:
                found |= _read_by(each)
            found |= {each.name for each in attribute.g.output}
    return found


def _read(model: onnx.ModelProto) -> set[str]:
    return {name for node in model.graph.node for name in _read_by(node)}


def _values(
    model: onnx.ModelProto, names: Sequence[str]
) -> Mapping[str, npt.NDArray[Any]] | None:
    """Compute some values on drawn inputs; None if that fails."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    del copy.graph.output[:]
    copy.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    try:
        runner = Runner(copy)
        return runner.run(drawn_inputs(runner, 0, open_sizes(0, copy)[0]))
    except RefusedError:
        return None


def _simpler(run: Shrinker, model: onnx.ModelProto) -> onnx.ModelProto:
    """Forget names of nodes and inputs that are weights; close open dimensions."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    for node in copy.graph.node:
        node.name = ""
    model = run.first(model, iter([copy])) if _differs(copy, model) else model
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    weights = {each.name for each in copy.graph.initializer}
    kept = [each for each in copy.graph.input if each.name not in weights]
    del copy.graph.input[:]
    copy.graph.input.extend(kept)
    model = run.first(model, iter([copy])) if _differs(copy, model) else model
    copy = plain_constants(model)
    return run.first(model, iter([copy])) if _differs(copy, model) else model


def _fewer_in_bodies(run: Shrinker, model: onnx.ModelProto) -> onnx.ModelProto:
    """Take nodes out of bodies as long as that helps."""
    while True:
        smaller = run.first(model, smaller_bodies(model))
        if smaller is model:
            return model
        model = smaller


def _differs(one: onnx.ModelProto, other: onnx.ModelProto) -> bool:
    return one.SerializeToString() != other.SerializeToString()
