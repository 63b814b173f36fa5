"""What onnxruntime's own int8 answers, beside what the nodes of a file say."""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import EvaluationError
from me2e_compress.fidelity.compare import Fidelity, Tally
from me2e_compress.manager.runtime_levels import first_node
from me2e_compress.manager.verification_inputs import VerificationInputs, relative
from me2e_compress.runtime.frames import Array, Frame, Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay
from me2e_compress.targets.onnxruntime import int8_rewrites
from me2e_compress.targets.quantized import describe_quantized

APART_DB = 6.0
"""From how much more noise on, in dB, an output is named: twice the amplitude."""

QUIET_DB = 30.0
"""Outputs with an SQNR above that are not named: int8 kernels round ties otherwise than
the nodes do, which is 36 dB of the driver's noisiest output (without any overflow)."""

_OVERFLOW = (
    "sums of uint8 by int8 overflow 16 bits on this processor, which has no VNNI: set"
    " session.x64quantprecision to 1, as profile and evaluate do"
)

_NAMED = 5
"""How many layers a line names."""


@dataclasses.dataclass(frozen=True)
class RuntimeLoss:
    """How onnxruntime's int8 kernels compute an int8 graph on this processor.

    Attributes:
        sqnr_db: SQNR of the outputs that they answer otherwise than the nodes, dB.
        nodes_db: SQNR of the same outputs by the nodes as they stand, dB.
        causes: layers, and what is done to them; the first node, where no rule knows.
    """

    sqnr_db: Mapping[str, float]
    nodes_db: Mapping[str, float]
    causes: tuple[str, ...] = ()

    def lines(self) -> Iterator[str]:
        """Yield what the runtime answers otherwise, and why; nothing if it does not."""
        if not self.sqnr_db:
            return
        apart = ", ".join(
            f"{name} {value:z.1f} dB (its nodes {self.nodes_db[name]:z.1f})"
            for name, value in self.sqnr_db.items()
        )
        yield f"onnxruntime's int8 answers otherwise than the file: {apart}"
        more = len(self.causes) - _NAMED
        for cause in self.causes[:_NAMED]:
            yield f"the runtime's, not the file's: {cause}"
        if more > 0:
            yield f"the runtime's, not the file's: {more} layers more (lint names them)"


class RuntimeTally:
    """Compares a graph, as onnxruntime's int8 runs it, with a reference.

    Args:
        session: the graph, with int8 kernels.
        frames: those that the reference is shown.
    """

    def __init__(self, session: Session, frames: Frames) -> None:
        self._answers = replay(session, frames)
        self._tallies: dict[str, Tally] = {}
        self._first: dict[str, float] = {}
        self._frame: Frame | None = None
        self._provider = session.provider

    def add(
        self, reference: dict[str, Array], nodes: dict[str, Array], frame: Frame
    ) -> None:
        """Add a frame: what the reference and the nodes of the graph answered."""
        answers = next(self._answers)
        for name in (each for each in nodes if each in reference):
            tally = self._tallies.setdefault(name, Tally(name))
            try:
                tally.add(reference[name], answers[name], frame.index)
            except EvaluationError:  # no number: noise without end
                tally.noise = float("inf")
            if self._frame is None:
                self._first[name] = relative(nodes[name], answers[name])
        self._frame = self._frame or frame

    def result(self, model: ir.Model, fidelity: Fidelity) -> RuntimeLoss:
        """Return what is noisier than by the nodes, and the causes."""
        nodes = {each.name: each.sqnr_db for each in fidelity.outputs}
        runs = {name: tally.result().sqnr_db for name, tally in self._tallies.items()}
        apart = [
            name
            for name, sqnr in runs.items()
            if sqnr < QUIET_DB and sqnr <= nodes[name] - APART_DB
        ]
        if not apart:
            return RuntimeLoss({}, {})
        shaped = model.clone()
        graph.infer_shapes(shaped)
        causes = [f"{each.node}: {each.message}" for each in int8_rewrites(shaped)]
        worst = max(apart, key=lambda name: self._first[name])
        if not causes and self._overflows(model):
            causes = [_OVERFLOW]
        elif not causes and (node := self._first_node(model, worst)) is not None:
            causes = [f"{worst} differs from {node.name} ({node.op_type}) on"]
        return RuntimeLoss(
            {name: runs[name] for name in apart},
            {name: nodes[name] for name in apart},
            tuple(causes),
        )

    def _overflows(self, model: ir.Model) -> bool:
        """Return whether an output is 6 dB nearer its nodes with sums of 32 bits."""
        if self._frame is None:
            return False
        provider, shown = self._provider, [self._frame]
        (nodes,) = replay(Session(model, provider=provider), shown)
        (stock,) = replay(Session(model, stock=True, provider=provider), shown)
        (wide,) = replay(Session(model, int8_kernels=True, provider=provider), shown)
        return any(
            4 * _noise(nodes[name], wide[name]) < _noise(nodes[name], stock[name])
            for name in nodes
        )

    def _first_node(self, model: ir.Model, output: str) -> ir.Node | None:
        """Return the first node from which an output is half as far off as at last."""
        allowed = self._first[output] / 2
        if self._frame is None or not allowed:
            return None
        inputs = VerificationInputs([self._frame], "recorded", self._provider)
        return first_node(model, output, "all", allowed, inputs, int8_kernels=True)


def _noise(a: Array, b: Array) -> float:
    return float(np.square(a.astype(np.float64) - b.astype(np.float64)).sum())


def has_int8_kernels(model: ir.Model, provider: Provider) -> bool:
    """Return whether onnxruntime would run a graph by int8 kernels of its own."""
    return provider.target == CPU.target and describe_quantized(model) is not None
