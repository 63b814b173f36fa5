"""What lossy passes did to a model, as it is said, shown and reported."""

import dataclasses
from collections.abc import Iterator, Mapping

from me2e_compress.fidelity.compare import Fidelity
from me2e_compress.fidelity.floor import Floor, Rounding, Shortfall, shown
from me2e_compress.fidelity.liveness import Liveness
from me2e_compress.workflows.result import Table, counted, table
from me2e_compress.workflows.runtime_loss import RuntimeLoss

NOT_ASKED = "--measure-frames 0"

FEW = 3
"""Fewer frames say little: four of one drive lay 12 to 15 dB from four others."""


@dataclasses.dataclass(frozen=True)
class MeasuredLoss:
    """How true a compressed model stayed, and where it did not.

    Attributes:
        fidelity: fidelity to the graph before the first lossy pass; None if not
            measured.
        on: which frames were used, or why nothing was measured, in words.
        incomparable: whether an output is not finite, or of another shape than before.
        unsteady: outputs that are not judged, with what they fall to in `rounding`:
            they pick between near-equal candidates.
        rounding: outputs below the floor that fall below it, uncompressed, when the
            largest input alone is rounded; None if nothing is below.
        shortfalls: outputs below the floor, the worst first.
        guilty: the lossy passes, which cause the shortfalls between them.
        advice: the command that measures int8 module by module; empty where nothing is
            below the floor, or nothing is int8.
        liveness: which outputs still move; None if not asked.
        runtime: what onnxruntime's int8 answers otherwise; None if it is not for it.
        seconds: CPU time of measuring.
    """

    fidelity: Fidelity | None
    on: str
    floor: Floor
    unsteady: Mapping[str, float] = dataclasses.field(default_factory=dict)
    rounding: Rounding | None = None
    liveness: Liveness | None = None
    runtime: RuntimeLoss | None = None
    shortfalls: tuple[Shortfall, ...] = ()
    guilty: tuple[str, ...] = ()
    advice: str = ""
    seconds: float = 0.0
    incomparable: bool = False

    def lines(self) -> Iterator[str]:
        """Yield how far the outputs moved, and which are alive or not judged."""
        found = self.fidelity
        if found is not None:
            yield self._summary(found)
        elif self.on != NOT_ASKED:
            yield f"fidelity: not measured ({self.on})"
        if found is not None and self.rounding is not None:
            yield from self._rounded(found, self.rounding)
        if self.liveness is not None:
            yield from self.liveness.lines()
        if self.runtime is not None:
            yield from self.runtime.lines()

    def alerts(self) -> Iterator[str]:
        """Yield what cannot be compared or is below the floor, and what helps."""
        if self.incomparable:
            yield f"the outputs cannot be compared: {self.on}"
        if self.liveness is not None:
            yield from self.liveness.faults
        if self.fidelity is not None and self.fidelity.frames < FEW:
            yield (
                f"this verdict rests on {counted(self.fidelity.frames, 'frame')}:"
                f" record {4 * FEW} or more, a quarter of which is measured on"
            )
        if self.shortfalls:
            low, guilty = ", ".join(map(str, self.shortfalls)), ", ".join(self.guilty)
            yield f"below the floor ({self.floor}): {low}; lost in {guilty}"
        if self.advice:
            yield f"{self.advice} measures which modules lose it"

    def table(self) -> Table | None:
        """Return the SQNR and largest error of every output; None if not measured."""
        found = self.fidelity
        if found is None:
            return None
        below = {each.output for each in self.shortfalls}
        said = {
            each.name: "not judged: whole numbers"
            for each in found.outputs
            if each.discrete
        }
        said |= dict.fromkeys(self.unsteady, "not judged: it picks")
        said |= dict.fromkeys(below, "below")
        rows = [
            (
                each.name,
                f"{each.sqnr_db:z.1f}",
                each.by_frame,
                f"{each.error:.1e}",
                said.get(each.name, "above"),
            )
            for each in found.outputs
        ]
        rows += [(name, "removed", "", "", "") for name in found.missing]
        columns = ("output", "SQNR dB", "by frame", "max|a-b|/max|a|", "floor")
        title = f"Fidelity on {counted(found.frames, 'frame')} {self.on}"
        return table(title, columns, rows)

    def record(self) -> dict[str, object]:
        """Return what the report says of it: all but the time."""
        names = (each.name for each in dataclasses.fields(self))
        return {name: getattr(self, name) for name in names if name != "seconds"}

    def _summary(self, found: Fidelity) -> str:
        """Return how far the plan moved, and which output is the noisiest."""
        said = []
        if found.plan is not None:
            said.append(
                f"the plan moves {found.plan.mean_m:.3f} m on average,"
                f" {found.plan.max_m:.2f} m at most"
            )
        others = [each for each in found.outputs if each.name != found.plan_output]
        judged = [e for e in others if not e.discrete and e.name not in self.unsteady]
        if judged:
            worst = min(judged, key=lambda each: each.sqnr_db)
            noise, spread = shown(worst.sqnr_db, "dB"), worst.by_frame
            spread = f" ({spread} by frame)" if spread else ""
            said.append(f"the noisiest output is {worst.name}, {noise}{spread}")
        where = f"on {counted(found.frames, 'frame')} {self.on}"
        return f"{'; '.join(said) or 'no output could be judged'} ({where})"

    def _rounded(self, found: Fidelity, rounding: Rounding) -> Iterator[str]:
        """Say what rounding one input does to the graph before; nothing in silence."""
        plan = "" if found.plan is None else found.plan_output
        for choice in dict.fromkeys(map(rounding.choices.get, rounding.values)):
            low = ", ".join(
                f"{name} ({shown(value, 'm' if name == plan else 'dB')})"
                for name, value in rounding.values.items()
                if rounding.choices.get(name) == choice
            )
            alone = (
                f"{low}: so low falls the graph itself, uncompressed, when only"
                f" {rounding.input} is rounded to int8"
            )
            yield (
                f"not judged: {alone}; it picks between near-equal candidates at"
                f" {choice}, and the road tells what that means"
                if choice
                else f"judged, though int8 may be too coarse for it: {alone}, and"
                " nothing picks on the way"
            )
