"""Judge many int8 variants of one float model that is calibrated once."""

import dataclasses
from functools import partial

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.fidelity.compare import Fidelity, Reference
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.quantization.plan import Overrides, QuantPlan, make_plan
from me2e_compress.quantization.plan.overrides import keep_float
from me2e_compress.quantization.rules import RuleSet
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session
from me2e_compress.targets import Target


@dataclasses.dataclass(frozen=True)
class Int8Choice:
    """The modules that are int8, in map order, and their nodes that stay float."""

    modules: tuple[str, ...]
    floats: tuple[str, ...] = ()

    def overrides(self) -> Overrides:
        """Build the overrides that keep the nodes in float."""
        return Overrides(
            override=tuple(keep_float(name, "sensitive") for name in self.floats)
        )


@dataclasses.dataclass(frozen=True)
class Score:
    """The fidelity of an int8 variant to the float model, and its weights' bytes."""

    fidelity: Fidelity
    weight_bytes: int

    @property
    def loss(self) -> float:
        """Metres that the plan moves, mean over the frames; smaller is better.

        For a model whose plan is not known, the noise amplitude of its worst output,
        relative to the signal: 10^(-SQNR / 20).
        """
        if self.fidelity.plan is not None:
            return self.fidelity.plan.mean_m
        worst = min(each.sqnr_db for each in self.fidelity.outputs)
        return float(10 ** (-worst / 20))

    @property
    def unit(self) -> str:
        """Unit of the loss."""
        return "m" if self.fidelity.plan is not None else "of the signal"


class Trials:
    """Makes int8 variants of a model and judges them; each choice once.

    ``model`` is the float graph after the exact passes, shapes inferred; fidelity is
    judged on the graph as ``target`` writes it; ``ranges`` cover every tensor that any
    variant needs; ``frames`` are read once for every variant. ``reference`` holds the
    float model's answers, ``done`` counts the variants that were built and run.
    """

    def __init__(
        self,
        model: ir.Model,
        modules: ModuleMap,
        rules: RuleSet,
        target: Target,
        ranges: Ranges,
        frames: Frames,
        *,
        provider: Provider = CPU,
    ) -> None:
        self.model = model
        self.modules = modules
        self.done = 0
        self._rules = rules
        self._target = target
        self.ranges = ranges
        self._session = partial(Session, release=True, provider=provider)
        # every choice is judged once
        self._known: dict[Int8Choice, Score] = {}
        self.reference = Reference.of(self._session(model), frames)

    def plan(self, choice: Int8Choice) -> QuantPlan:
        """Decide for every node, as ``quantize-int8`` will for the recipe."""
        scheme = QuantScheme.of(choice.modules, self.modules)
        pins, target = choice.overrides(), self._target
        return make_plan(
            self.model,
            scheme,
            self._rules,
            pins,
            target.costs,
            target.fused_objection,
        )

    def variant(self, choice: Int8Choice) -> ir.Model:
        """Build the graph of a choice."""
        if not choice.modules:
            return self.model
        return self._target.place(self.model, self.plan(choice), self.ranges)

    def score(self, choice: Int8Choice) -> Score:
        """Build, run and judge a choice."""
        if choice not in self._known:
            graph_of_choice = self.variant(choice)
            self._known[choice] = Score(
                self.reference.compare(self._session(graph_of_choice)),
                graph.size(graph_of_choice).weight_bytes,
            )
            self.done += 1
        return self._known[choice]
