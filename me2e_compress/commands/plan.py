"""Plan which nodes become int8 and which stay float, by which rule, and why."""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import table
from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.calibration.observers import DEFAULT_METHOD
from me2e_compress.commands.checks import (
    load_graph,
    load_map,
    model_path,
    shortcomings,
    writing,
)
from me2e_compress.commands.options import PlanOptions
from me2e_compress.commands.result import Result, View
from me2e_compress.driving.adapter.outputs import write_port_metadata
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.freeze_inputs import advice
from me2e_compress.passes.quantize_int8 import QuantizeInt8, Quantizer, refuse_quantized
from me2e_compress.quantization.decision import (
    METADATA,
    QuantPlan,
    load_plan,
    plan_of,
    save_plan,
)
from me2e_compress.quantization.rules import DEFAULT_RULES, RULE_SETS
from me2e_compress.shipped.drivers import map_name
from me2e_compress.targets import DEFAULT_TARGET, TARGETS

# The rules that need all ranges that others do: an override may lift those
_MOST_RANGES = "paper{without=[fused-operator]}"


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedGraph:
    """A graph as the pass that reads ranges gets it."""

    file: Path
    model: ir.Model
    modules: ModuleMap
    reader: Quantizer | None  # that pass, if the recipe has one

    @classmethod
    def of(
        cls,
        file: Path,
        loaded: ir.Model,
        module_map: str | Path | ModuleMap | None,
        passes: Sequence[Pass] | None = None,
    ) -> Self:
        """Run the passes before the first that reads ranges, unverified.

        A map of None finds the preset; passes of None are the recipe ``exact``.

        Raises:
            PreconditionError: A plan quantized the graph, and it is to become int8.
        """
        chosen = tuple(recipe.load("exact") if passes is None else passes)
        readers = (step for step in chosen if isinstance(step, Quantizer))
        reader = next(readers, None)
        at = None if reader is None else chosen.index(reader)
        # what a plan quantized may only be rewritten, not quantized again
        if (reader is None or reader.takes_float) and METADATA in loaded.metadata_props:
            refuse_quantized(loaded)
        if not isinstance(module_map, ModuleMap):
            module_map = load_map(module_map, loaded)
        # exact passes are verified when the graph is compressed
        manager = PassManager(chosen[:at], verify_frames=0)
        model = manager.run(loaded, Context(module_map)).model
        graph.infer_shapes(model)
        # weights are copied out of the protobuf message that the file was read into: a
        # single one left there would keep the whole message in memory
        for value in (v for g in model.graphs() for v in g.initializers.values()):
            tensor = value.const_value
            if isinstance(tensor, ir.serde.TensorProtoTensor):
                array, name = tensor.numpy().copy(), value.name
                value.const_value = ir.Tensor(array, dtype=tensor.dtype, name=name)
        return cls(file, model, module_map, reader)

    @property
    def method(self) -> str:
        """Return how the pass that reads ranges wants them measured."""
        return DEFAULT_METHOD if self.reader is None else self.reader.method_of_ranges

    def tensors(self) -> tuple[str, ...]:
        """Return every tensor that any scheme, rule set or target needs a range of.

        Raises:
            PreconditionError: There is none, or a quantized graph lacks none.
        """
        context, names = Context(self.modules), dict[str, None]()
        if self.reader is not None and not self.reader.takes_float:
            names |= dict.fromkeys(self.reader.ranged_tensors(self.model, context))
            none = (
                f"it tells every range that {self.reader.name} needs: none to measure"
            )
        else:
            sets, none = (*RULE_SETS.usable(), _MOST_RANGES), "no node can become int8"
            for rules, target in itertools.product(sets, TARGETS.usable()):
                every = QuantizeInt8(
                    scheme=self.modules.names(), rules=rules, target=target
                )
                plan = every.plan(self.model, context)
                tensors = TARGETS.parse(target).tensors(plan, self.model)
                names |= dict.fromkeys(tensors)
        if not names:
            raise PreconditionError(f"{self.file}: {none}")
        return tuple(names)


@dataclasses.dataclass(frozen=True, repr=False)
class PlanResult(Result):
    """A plan."""

    keys = ("*plan",)
    plan: QuantPlan  # the decision for every node
    hint: str = ""  # what the graph lacks for more to be known, else empty

    def view(self, every: bool = False) -> View:
        """Return nodes by module and rule; with `every` also by decision and scale."""
        lines = filter(None, (self.hint, self.plan.headline))
        tables = list(self.plan.tables())
        if not every:
            return View(self.plan.headline, tables, lines)
        # A row a node that could be int8, then the Concats of one scale
        rows = list[tuple[str, str]]()
        for decision in self.plan.decisions:
            if decision.could_be_int8:
                of_module = f" of {decision.module}" if decision.module else ""
                why = f"{decision.dtype} by {decision.rule}, {decision.reason}"
                name = decision.node or decision.output
                rows.append((name, f"{decision.op}{of_module}: {why}"))
        what = ("node", "what, by which rule, why")
        tables.append(table("Decisions", what, rows, words=2))
        groups = [
            (group.name, ", ".join(group.tensors), ", ".join(group.nodes))
            for group in self.plan.groups
        ]
        if groups:
            columns = ("Concat", "tensors", "read by")
            tables.append(table("On one scale", columns, groups, words=3))
        return View(self.plan.headline, tables, lines)


def plan(
    model: str | Path,
    output: str | Path | None = None,
    options: PlanOptions | None = None,
) -> PlanResult:
    """Decide for every node whether it becomes int8, as ``compress`` will.

    The model is an ONNX file, the name of one that ships, or a saved plan; a file that
    carries its plan is not planned again. The plan is written as JSON if `output` is
    given.

    Raises:
        GraphError: The model does not exist, or the output would harm an input.
        RecipeError: A plan, scheme or rule set is not usable, or options are given for
            a plan that is made already.
        PreconditionError: The graph is quantized and carries no plan, or its opset or
            float type has no int8.
    """
    options = options or PlanOptions()
    source = model_path(model)
    written = None if output is None else Path(output)
    inputs = (source, options.overrides, options.module_map)
    with writing([written], inputs, force=options.force):
        # A file is a plan, carries one, or is a float graph to plan
        is_plan = source.suffix == ".json"
        loaded = None if is_plan else load_graph(source)
        known = load_plan(source) if loaded is None else plan_of(loaded)
        if known is not None:
            # Options that would change nothing
            names = ("overrides", "scheme", "rules", "target")
            if option := next((name for name in names if getattr(options, name)), None):
                raise RecipeError(
                    f"--{option} is for a plan that is yet to be made, and {source} has"
                    " its own: give the float model"
                )
            result = PlanResult(known)
        else:
            assert loaded is not None
            # Plan the graph after the exact passes
            quantizer = QuantizeInt8(
                scheme=options.scheme or "full",
                rules=options.rules or DEFAULT_RULES,
                target=options.target or DEFAULT_TARGET,
                overrides=None
                if options.overrides is None
                else Path(options.overrides),
            )
            write_port_metadata(loaded, None, options.module_map or map_name(source))
            ready = PreparedGraph.of(source, loaded, options.module_map)
            decided = quantizer.plan(ready.model, Context(ready.modules))
            TARGETS.parse(quantizer.target).check_types(decided, ready.model)
            hints = filter(None, (shortcomings(loaded), advice(loaded)))
            result = PlanResult(decided, "; ".join(hints))
        if written is not None:
            save_plan(result.plan, written)
    return result
