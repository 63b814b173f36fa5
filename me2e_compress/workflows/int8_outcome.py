"""What a compression made int8, and what stayed float and why."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Self

from me2e_compress.graph import WEIGHTED
from me2e_compress.manager import Report
from me2e_compress.manager.report import LossyPass
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.float_weights import FloatWeight, float_weights
from me2e_compress.quantization.plan import QuantPlan, plan_of, savable_bytes

LISTED = 10
"""Number of float weights that a report lists."""


@dataclasses.dataclass(frozen=True)
class Int8Outcome:
    """What the pass that quantizes achieved.

    Attributes:
        by: name of the pass.
        nodes: number of nodes that it made int8.
        layers: number of convolutions and matrix products in all modules; None where
            the pass leaves no plan.
        kept: how many of those each rule keeps float, with its reason, most first.
        weights: the largest weights that stayed float, at most `LISTED`.
        float_bytes: bytes of all weights that stayed float, by rule, most first.
        weight_only_bytes: bytes that ``weight_only_gemv`` would save; 0 where it is on,
            or where they are few.
    """

    by: str
    nodes: int
    layers: int | None = None
    kept: Mapping[str, int] = dataclasses.field(default_factory=dict)
    weights: tuple[FloatWeight, ...] = ()
    float_bytes: Mapping[str, int] = dataclasses.field(default_factory=dict)
    weight_only_bytes: int = 0

    @classmethod
    def of(cls, report: Report, context: Context) -> Self | None:
        """Read the outcome from a run of the manager; None where no pass quantizes."""
        quantizer = next((e for e in report.lossy if e.applied.quantizes), None)
        if quantizer is None:
            return None
        name, changes = quantizer.applied.name, quantizer.changes
        # without a plan only the number of changes is known
        plan = _plan(report, quantizer, context)
        if plan is None:
            return cls(name, changes)
        # a layer is left if it is neither int8 nor has int8 weights
        layers = [each for each in plan.decisions if each.op in WEIGHTED]
        placed = {each.output for each in (*plan.placed, *plan.weight_only)}
        left = [each for each in layers if each.output not in placed]
        weights = float_weights(quantizer.before, plan)
        return cls(
            name,
            changes,
            len(layers),
            dict(Counter(f"{e.rule}: {e.reason}" for e in left).most_common()),
            weights[:LISTED],
            _by_rule(weights),
            savable_bytes(plan, quantizer.before)[1],
        )

    @property
    def empty(self) -> str:
        """Why nothing became int8, in one line; empty if something did."""
        if self.nodes:
            return ""
        # say what the layers are kept float by, the commonest rules first
        found = [f"{self.by} made nothing int8"]
        if self.layers is not None:
            found.append(f"{self.layers} convolutions and matrix products in the graph")
        found += [f"{count} by rule {why}" for why, count in self._first_kept()]
        if self.weights:
            largest = self.weights[0]
            found.append(
                f"the largest weight is {largest.name} of {largest.op}"
                f" {largest.node!r}, rule {largest.rule}: {largest.reason}"
            )
        return "; ".join(found)

    def _first_kept(self) -> list[tuple[str, int]]:
        return list(self.kept.items())[:2]


def _by_rule(weights: Iterable[FloatWeight]) -> dict[str, int]:
    found = Counter[str]()
    for each in weights:
        found[each.rule] += each.bytes
    return dict(found.most_common())


def _plan(report: Report, quantizer: LossyPass, context: Context) -> QuantPlan | None:
    """Return the plan that was carried out; if nothing changed, make it again."""
    found = plan_of(report.model) if quantizer.changes else None
    if found is None and isinstance(quantizer.applied, QuantizeInt8):
        found = quantizer.applied.plan(quantizer.before, context)
    return found
