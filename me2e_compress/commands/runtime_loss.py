"""What a runtime's own int8 kernels answer otherwise than an int8 graph says."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping

import onnx_ir as ir

from me2e_compress.fidelity.compare import Fidelity, SetFidelity, SetTally, Tally
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.runnable import int8_entry
from me2e_compress.runtime.session import Session, replay
from me2e_compress.targets import TARGETS
from me2e_compress.targets.quantized import describe_quantized

NOISIER_DB = 6.0
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
    """How a runtime's int8 kernels compute an int8 graph on this processor.

    Attributes:
        sqnr_db: SQNR of the outputs that they answer otherwise than the nodes, dB.
        nodes_db: SQNR of the same outputs by the nodes as they stand, dB.
        causes: layers, and what is done to them; none where no rule knows.
        engine: what runs it.
    """

    sqnr_db: Mapping[str, float]
    nodes_db: Mapping[str, float]
    causes: tuple[str, ...] = ()
    engine: str = CPU.engine

    def lines(self) -> Iterator[str]:
        """Yield what the runtime answers otherwise, and why; nothing if it does not."""
        if not self.sqnr_db:
            return
        outputs = ", ".join(
            f"{name} {value:z.1f} dB (its nodes {self.nodes_db[name]:z.1f})"
            for name, value in self.sqnr_db.items()
        )
        yield f"{self.engine}'s int8 answers otherwise than the file: {outputs}"
        more = len(self.causes) - _NAMED
        for cause in self.causes[:_NAMED]:
            yield f"the runtime's, not the file's: {cause}"
        if more > 0:
            yield f"the runtime's, not the file's: {more} layers more (lint names them)"


class RuntimeTally:
    """Compares a graph, as a runtime's int8 runs it, with a reference.

    Args:
        session: the graph, with int8 kernels.
        frames: those that the reference is shown.
        sets: a tally of the outputs that are sets, which are matched here, too.
    """

    def __init__(
        self, session: Session, frames: Iterable[Frame], sets: SetTally | None = None
    ) -> None:
        self._answers, self._provider = replay(session, frames), session.provider
        self._sets = None if sets is None else SetTally(sets.outputs)
        self._tallies: dict[str, Tally] = {}

    def add(
        self, reference: dict[str, Array], nodes: dict[str, Array], frame: Frame
    ) -> None:
        """Add the next frame's outputs: those of the reference and of the nodes."""
        answers = next(self._answers)
        for name in (each for each in nodes if each in reference):
            tally = self._tallies.setdefault(name, Tally(name))
            tally.add(reference[name], answers[name], frame.index)
        if self._sets is not None:
            self._sets.add(reference, answers, frame)

    def result(
        self, model: ir.Model, fidelity: Fidelity, agents: SetFidelity | None = None
    ) -> RuntimeLoss:
        """Return the outputs noisier than by the nodes, by `NOISIER_DB`, and causes."""
        nodes = {each.name: each.sqnr_db for each in fidelity.outputs}
        runs = {name: tally.sqnr_db for name, tally in self._tallies.items()}
        if agents is not None and self._sets is not None:
            nodes.update(agents.sqnr_db)
            runs.update(self._sets.result().sqnr_db)
        noisier = [
            name
            for name, sqnr in runs.items()
            if sqnr < QUIET_DB
            and sqnr < nodes[name]
            and sqnr <= nodes[name] - NOISIER_DB
        ]
        if not noisier:
            return RuntimeLoss({}, {})
        # the rules of its target know the causes
        known = TARGETS.parse(self._provider.target).lint(model)
        causes = [f"{e.node}: {e.message}" for e in known if e.severity == "wrong"]
        if not causes and self._provider == CPU and int8_entry()[1] == "1":
            causes = [_OVERFLOW]
        return RuntimeLoss(
            {name: runs[name] for name in noisier},
            {name: nodes[name] for name in noisier},
            tuple(causes),
            self._provider.engine,
        )


def has_int8_kernels(model: ir.Model, provider: Provider) -> bool:
    """Return whether a provider runs a graph by int8 kernels that can be left out."""
    return provider.target != "tensorrt" and describe_quantized(model) is not None
