"""Compute once what does not depend on the inputs."""

import dataclasses
from collections import Counter
from typing import ClassVar

import onnx_ir as ir

from me2e_compress import graph as graphs
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.fold_constants import commit, evaluation
from me2e_compress.passes.fold_constants.choice import choose
from me2e_compress.passes.fold_constants.knowledge import Sweep
from me2e_compress.passes.fold_constants.ranges import seat_ranges
from me2e_compress.passes.import_normalize import constants
from me2e_compress.rewrite import Array, graphs_of, remove_dead

__all__ = ["FoldConstants"]


@dataclasses.dataclass
class _Tally:
    lifted: int = 0
    seated: int = 0
    dead: int = 0
    folded: int = 0
    stored: int = 0
    kept: int = 0
    growth_bytes: int = 0
    refused: Counter[str] = dataclasses.field(default_factory=Counter)

    @property
    def changes(self) -> int:
        return self.lifted + self.seated + self.dead + self.folded


@dataclasses.dataclass(frozen=True)
class FoldConstants(Pass):
    """Replace what depends on weights and static shapes alone by its value.

    Given:   Shape(x) -> Gather(1) -> Concat -> Reshape;  Transpose(weight) -> MatMul
    Result:  Reshape and MatMul read initializers

    Attributes:
        bytes_per_node: how many bytes a removed node may cost. A fold that shrinks
            the weights is always taken, one that grows them only up to this price,
            so that a position table repeated for every token stays computed.
        through_compute: fold through products, convolutions and softmax too (by the
            same price); False keeps every named layer, e.g. to ablate it later.
    """

    name: ClassVar[str] = "fold-constants"
    exact: ClassVar[bool] = True
    bytes_per_node: int = 512
    through_compute: bool = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Infer shapes, then fold every graph of the model, outermost first."""
        tally = _Tally(lifted=constants.lift(model))
        for body in graphs_of(model.graph):
            tally.seated += seat_ranges(body, model.opset_imports, self.name)
        before = -1
        while tally.changes > before:
            before = tally.changes
            tally.dead += remove_dead(model.graph)
            tally.kept = 0
            for body in list(graphs_of(model.graph)):
                self._fold(body, model.opset_imports, tally, trust=body is model.graph)
        return PassResult(model, tally.changes, _notes(tally))

    def _fold(
        self, body: ir.Graph, opsets: dict[str, int], tally: _Tally, *, trust: bool
    ) -> None:
        refused: set[ir.Node] = set()
        fresh: set[ir.Value] = set()
        while True:
            known = Sweep(
                opsets,
                refused,
                fresh,
                through_compute=self.through_compute,
                trust_shapes=trust,
            ).run(body)
            choice = choose(known, self.bytes_per_node)
            asked = [value for value in choice.values if value not in known.arrays]
            found, failed = evaluation.evaluate(asked, known, opsets)
            tally.refused.update(node.op_type for node in failed)
            refused.update(failed)
            if failed or _learn(asked, found):
                continue
            known.arrays.update(found)
            if not choice.gone:
                tally.kept += choice.kept
                return
            fresh.update(commit.commit(body, choice, known.arrays, self.name))
            tally.folded += sum(len(one.nodes) for one in choice.gone)
            tally.stored += len(choice.values)
            tally.growth_bytes += choice.growth_bytes


def _learn(asked: list[ir.Value], found: dict[ir.Value, Array]) -> bool:
    """Record shapes that only evaluation could tell; True if there were any."""
    learnt = False
    for value in asked:
        if graphs.static_shape(value) is None and not value.is_graph_output():
            value.shape = ir.Shape(found[value].shape)
            learnt = True
    return learnt


def _notes(tally: _Tally) -> tuple[str, ...]:
    notes = []
    if tally.folded:
        notes.append(
            f"{tally.folded} nodes became {tally.stored} initializers"
            f" ({tally.growth_bytes:+,} bytes)"
        )
    if tally.kept:
        notes.append(
            f"{tally.kept} nodes go on computing constants: cheaper than their bytes"
        )
    if tally.refused:
        what = ", ".join(f"{count} {op}" for op, count in sorted(tally.refused.items()))
        notes.append(f"onnxruntime cannot evaluate {what}: left as they are")
    return tuple(notes)
