"""Plan which nodes become int8 and which stay float, by which rule, and why."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import RecipeError
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.plan import (
    Decision,
    PlanDifference,
    QuantPlan,
    differences,
    load_plan,
    plan_of,
    save_plan,
)
from me2e_compress.quantization.rules import DEFAULT_RULES, RuleSet
from me2e_compress.targets import DEFAULT_TARGET
from me2e_compress.workflows.checks import lacking_shapes, model_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.prepare_int8 import PreparedGraph
from me2e_compress.workflows.result import Result, Table, table


@dataclasses.dataclass(frozen=True)
class PlanOptions:
    """How a graph is planned; a plan that is made already takes no options.

    Attributes:
        scheme: ``feature-ext``, ``prediction``; None is ``full``.
        rules: ``safe``, ``paper``, or a set of yours; None is ``safe``.
        target: runtime of the int8 graph; None is ``onnxruntime``.
        overrides: TOML file of exceptions.
        module_map: preset or TOML file; None finds the preset.
        force: replace outputs that we did not write, too.
    """

    scheme: str | None = None
    rules: str | RuleSet | None = None
    target: str | None = None
    overrides: str | Path | None = None
    module_map: str | Path | None = None
    force: bool = False


@dataclasses.dataclass(frozen=True, repr=False)
class PlanResult(Result):
    """A plan, and how it differs from another.

    Attributes:
        plan: the decision for every node.
        changes: nodes that another plan decides differently; None without another plan.
        hint: what the graph lacks for more to be known, else empty.
    """

    plan: QuantPlan
    changes: tuple[PlanDifference, ...] | None = None
    hint: str = ""

    @property
    def headline(self) -> str:
        """The number of int8 nodes by rule, or of differences."""
        if self.changes is not None:
            return f"{len(self.changes)} differences"
        return self.plan.headline

    def lines(self) -> tuple[str, ...]:
        """Return the differences, and the headline."""
        said = filter(None, (self.hint, self.headline))
        return (*map(str, self.changes or ()), *said)

    def tables(self) -> tuple[Table, ...]:
        """Return how many nodes of each module became what, by which rule."""
        return () if self.changes is not None else self.plan.tables()

    def nodes(self) -> tuple[Table, ...]:
        """Return one row per node that could be int8, and what was decided together."""
        if self.changes is not None:
            return ()
        rows = [
            (each.node or each.output, _what(each))
            for each in self.plan.decisions
            if each.could_be_int8
        ]
        shown = table("Decisions", ("node", "what, by which rule, why"), rows, words=2)
        return shown, *self._groups()

    def _groups(self) -> tuple[Table, ...]:
        rows = [
            (group.name, group.kind, ", ".join(group.tensors), ", ".join(group.nodes))
            for group in self.plan.groups
        ]
        if not rows:
            return ()
        columns = ("of", "kind", "tensors", "read by")
        return (table("Decided together", columns, rows, words=4),)

    def to_json(self) -> object:
        """Return the plan, or the differences from another."""
        if self.changes is None:
            return dataclasses.asdict(self.plan)
        return {"differences": self.changes}


def plan(
    model: str | Path,
    output: str | Path | None = None,
    against: str | Path | None = None,
    options: PlanOptions | None = None,
) -> PlanResult:
    """Decide for every node whether it becomes int8, as ``compress`` will.

    The model is an ONNX file, the name of one that ships, or a saved plan; a file that
    carries its plan is not planned again. The plan is written as JSON if `output` is
    given, and compared with another model or plan, `against`, without overrides for a
    float model.

    Raises:
        GraphError: The model does not exist, or the output would harm an input.
        RecipeError: A plan, scheme or rule set is not usable, or options are given for
            a plan that is made already.
        PreconditionError: The graph is quantized and carries no plan.
    """
    options = options or PlanOptions()
    files = [model_path(model), *([] if against is None else [model_path(against)])]
    written = None if output is None else Path(output)
    inputs = (*files, options.overrides, options.module_map)
    with writing([written], inputs, force=options.force):
        return _planned(files, written, options)


def _planned(
    files: Sequence[Path], written: Path | None, options: PlanOptions
) -> PlanResult:
    # a file is a plan, carries one, or is a float graph to plan
    read = [_read(path) for path in files]
    _check_options(options, files, read)
    # overrides apply to the first plan only: the other shows what they change
    plain = QuantizeInt8(
        scheme=options.scheme or "full",
        rules=options.rules or DEFAULT_RULES,
        target=options.target or DEFAULT_TARGET,
    )
    overrides = None if options.overrides is None else Path(options.overrides)
    chosen = dataclasses.replace(plain, overrides=overrides)
    found = _made(files[0], read[0], chosen, options)
    if written is not None:
        save_plan(found, written)
    if len(files) == 1:
        hint = "" if isinstance(read[0], QuantPlan) else lacking_shapes(read[0])
        return PlanResult(found, hint=hint)
    other = _made(files[1], read[1], plain, options)
    return PlanResult(found, tuple(differences(other, found)))


def _what(decision: Decision) -> str:
    where = f" of {decision.module}" if decision.module else ""
    close = f" ({decision.borderline})" if decision.borderline else ""
    said = f"{decision.dtype} by {decision.rule}, {decision.reason}{close}"
    return f"{decision.op}{where}: {said}"


def _read(path: Path) -> QuantPlan | ir.Model:
    """Read the plan that a file is or carries, else its graph."""
    if path.suffix == ".json":
        return load_plan(path)
    model = graph.load(path)
    return plan_of(model) or model


def _check_options(
    options: PlanOptions,
    files: Sequence[Path],
    read: Sequence[QuantPlan | ir.Model],
) -> None:
    """Refuse options that would change nothing, because all plans are made already."""
    names = ("scheme", "rules", "target", "overrides")
    given = [name for name in names if getattr(options, name)]
    only = read[:1] if "overrides" in given else read
    if given and all(isinstance(each, QuantPlan) for each in only):
        option = "overrides" if "overrides" in given else given[0].replace("_", "-")
        raise RecipeError(
            f"--{option} is for a plan that is yet to be made, and {files[0]} has its"
            " own: give the float model"
        )


def _made(
    file: Path,
    read: QuantPlan | ir.Model,
    quantizer: QuantizeInt8,
    options: PlanOptions,
) -> QuantPlan:
    """Return a plan as it is, or plan a float graph after the exact passes."""
    if isinstance(read, QuantPlan):
        return read
    ready = PreparedGraph.of(file, read, options.module_map)
    return quantizer.plan(ready.model, Context(ready.modules))
