"""Check whether the runtime that is to run a graph would accept it."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import PreconditionError, RecipeError
from me2e_compress.passes import Context
from me2e_compress.passes.fix_shapes import FixShapes
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets import TARGETS, LintFinding, Target
from me2e_compress.targets.tensorrt.rtx import BuildResult, check
from me2e_compress.workflows.checks import load_map, model_path
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Status, Table, counted, table


@dataclasses.dataclass(frozen=True)
class LintOptions:
    """The runtime that is asked, and how.

    Attributes:
        target: ``tensorrt`` or ``onnxruntime``.
        trt_check: also parse and build the graph by TensorRT-RTX.
        sm: GPU generation that is built for.
        dims: sizes that open dimensions of the inputs are given first: ``batch`` to 1.
        provider: what opens a graph for onnxruntime.

    Raises:
        RecipeError: TensorRT-RTX or a provider is given for a target it does not serve.
    """

    target: str = "tensorrt"
    trt_check: bool = False
    sm: int = 86
    dims: Mapping[str, int] = dataclasses.field(default_factory=dict)
    provider: Provider = CPU

    def __post_init__(self) -> None:
        if self.trt_check and self.target != "tensorrt":
            raise RecipeError(f"--trt-check is for tensorrt, not for {self.target}")
        if self.provider != CPU and not self.judge.opens:
            raise RecipeError(
                f"--provider and --plugins are onnxruntime's: lint for {self.target}"
                " opens no session"
            )

    @functools.cached_property
    def judge(self) -> Target:
        """The target, whose rules judge the graph."""
        return TARGETS.parse(self.target)


@dataclasses.dataclass(frozen=True, repr=False)
class LintResult(Result):
    """The findings of our rules, and TensorRT-RTX's answer; None if not asked."""

    model: Path
    options: LintOptions
    findings: tuple[LintFinding, ...]
    build: BuildResult | None

    @property
    def refusal(self) -> str | None:
        """Why the target would refuse the graph, in one line; None if it would not."""
        errors = [each for each in self.findings if each.severity == "error"]
        if errors:
            first = errors[0]
            return (
                f"{self.model}: {self.options.target} refuses it,"
                f" {counted(len(errors), 'error')};"
                f" {first.rule} {first.node!r}: {first.message}"
            )
        if self.build is not None and not self.build.passed:
            return f"{self.model}: {_why(self.build)}"
        return None

    @property
    def status(self) -> Status:
        """``refused`` if the target would not accept the graph."""
        if self.refusal is not None:
            return "refused"
        return "warning" if self.findings else "ok"

    def check(self) -> None:
        """Raise PreconditionError unless the target accepts the graph."""
        if self.refusal is not None:
            raise PreconditionError(self.refusal)

    @property
    def headline(self) -> str:
        """The number of errors and warnings."""
        counts = Counter(each.severity for each in self.findings)
        return (
            f"{self.model.name} for {self.options.target}:"
            f" {counted(counts['error'], 'error')},"
            f" {counted(counts['warning'], 'warning')} (our own rules and operator"
            " tables)"
        )

    def lines(self) -> tuple[str, ...]:
        """Return the headline, and TensorRT-RTX's answer."""
        said = () if self.build is None else _said(self.build, self.options.sm)
        return (self.headline, *said)

    def tables(self, *, shown: int = 3) -> tuple[Table, ...]:
        """Return the findings, `shown` nodes of each rule; a note counts the others."""
        if not self.findings:
            return ()
        # a rule that fails everywhere would bury the others
        rows = list[tuple[str, ...]]()
        seen: Counter[tuple[str, str]] = Counter()
        for each in self.findings:
            key = (each.severity, each.rule)
            seen[key] += 1
            if seen[key] <= shown:
                rows.append((*key, each.node, each.message))
        more = (
            f"{severity} {rule}: {count - shown} more"
            for (severity, rule), count in seen.items()
            if count > shown
        )
        columns = ("", "rule", "node", "what")
        return (table("Findings", columns, rows, "\n".join(more), words=4),)

    def records(self) -> list[dict[str, object]]:
        """Return one row per finding."""
        return [dataclasses.asdict(each) for each in self.findings]

    def to_json(self) -> object:
        """Return the findings, and the answer of TensorRT-RTX."""
        return {"findings": self.findings, "tensorrt_rtx": self.build}


def lint(
    model: str | Path,
    options: LintOptions | None = None,
    listener: Listener = SILENT,
) -> LintResult:
    """Check a graph for the runtime that will run it.

    The model is an ONNX file or the name of one that ships. For onnxruntime it is
    opened too, if no rule says that it would be refused.

    Raises:
        GraphError: The model does not exist, or onnxruntime crashes on it.
        ProviderError: The provider is not available.
        RecipeError: The target does not exist.
        PreconditionError: No input has such an open dimension.
        MissingExtraError: TensorRT-RTX is asked for and not installed.
    """
    options, path = options or LintOptions(), model_path(model)
    loaded = graph.load(path)
    if options.dims:
        modules = load_map(None, loaded)
        loaded = FixShapes(options.dims).run(loaded, Context(modules)).model
    found = _found(loaded, path.name, options, listener)
    build = check(loaded, options.sm) if options.trt_check else None
    return LintResult(path, options, found, build)


def _found(
    model: ir.Model, name: str, options: LintOptions, listener: Listener
) -> tuple[LintFinding, ...]:
    """Return the rules' findings and, if none is an error, those of opening it."""
    judge, provider = options.judge, options.provider
    found = judge.lint(model)
    if any(each.severity == "error" for each in found):
        return found
    if judge.opens:
        try_first(model, name, listener=listener, provider=provider)
    # a node that a rule has named already is not named again
    known = {each.node for each in found if each.rule == "float-answer"}
    opened = [
        each for each in judge.read_back(model, provider) if each.node not in known
    ]
    return tuple(sorted((*found, *opened), key=lambda each: each.severity))


def _said(verdict: BuildResult, sm: int) -> tuple[str, ...]:
    int8 = Counter(each.kind for each in verdict.kernels if each.is_int8)
    every = Counter(each.kind for each in verdict.kernels)
    kernels = ", ".join(f"{int8[kind]} of {every[kind]} {kind}s" for kind in every)
    parsed = "parsed" if verdict.parsed else "not parsed"
    built = "built" if verdict.built else "not built"
    lines = [
        f"TensorRT-RTX {verdict.version}, on this CPU: {parsed}"
        + ("" if verdict.built is None else f", {built} for SM{sm}")
    ]
    if kernels:
        lines.append(f"kernels with int8 operands: {kernels}")
    if verdict.cut:
        lines.append(f"cut at {len(verdict.cut)} plugins: {', '.join(verdict.cut[:5])}")
    return tuple(lines)


def _why(verdict: BuildResult) -> str:
    if verdict.missing:
        return (
            f"{len(verdict.missing)} convolutions that the plan makes int8 have no int8"
            f" kernel, {verdict.missing[0]} first"
        )
    first = verdict.errors[0] if verdict.errors else "it does not say why"
    return f"TensorRT-RTX refuses it: {first}"
