"""Check whether the runtime that is to run a graph would accept it."""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import plural, table
from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.commands.checks import model_path, try_first
from me2e_compress.commands.options import LintOptions
from me2e_compress.commands.result import Result, Status, View
from me2e_compress.passes import Pass
from me2e_compress.passes.import_normalize import with_own_domains
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.decision import plan_of
from me2e_compress.runtime.providers import CPU
from me2e_compress.targets import (
    SEVERITIES,
    TARGETS,
    LintFinding,
    Severity,
    Target,
    worst_first,
)
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.tensorrt.rtx_check import BuildResult, check


@dataclasses.dataclass(frozen=True)
class RuleSummary:
    """Findings of one rule: number of nodes, and the first of them."""

    severity: Severity
    rule: str
    nodes: int
    first: str
    message: str


@dataclasses.dataclass(frozen=True, repr=False)
class LintResult(Result):
    """The findings of our rules, and TensorRT-RTX's answer."""

    model: Path
    options: LintOptions
    findings: tuple[LintFinding, ...]  # the worst first
    build: BuildResult | None = None  # TensorRT-RTX's answer; None if not asked
    asked: bool = True  # whether a user named the target; else a pass did

    @property
    def refusal(self) -> str | None:
        """Why the target would refuse the graph, in one line; None if it would not."""
        if reason := self._first("error", f"{self.options.target} refuses it"):
            return reason
        if self.build is not None and not self.build.passed:
            return f"{self.model}: {self.build.refusal}"
        return None

    @property
    def miscomputed(self) -> str | None:
        """What the target would run, and compute otherwise; None if nothing."""
        return self._first("wrong", f"{self.options.target} computes it otherwise")

    def _first(self, severity: Severity, what: str) -> str | None:
        """Return the count of a severity's findings and the first; None without any."""
        matches = [e for e in self.findings if e.severity == severity]
        if not matches:
            return None
        first, noun = matches[0], "error" if severity == "error" else "finding"
        return (
            f"{self.model}: {what}, {plural(len(matches), noun)};"
            f" {first.rule} {first.node!r}: {first.message}"
        )

    def view(self, every: bool = False) -> View:
        """Return counts and findings, three nodes a rule unless `every` is set."""
        # A rule that fails everywhere would bury the others
        rows, more, shown = list[tuple[str, ...]](), list[str](), None if every else 3
        for row in self.summary():
            key = row.severity, row.rule
            own = [e for e in self.findings if (e.severity, e.rule) == key]
            rows += [(*key, finding.node, finding.message) for finding in own[:shown]]
            if shown is not None and row.nodes > shown:
                more.append(f"{row.severity} {row.rule}: {row.nodes - shown} more")
        columns = ("", "rule", "node", "what")
        findings = table("Findings", columns, rows, "\n".join(more), words=4)
        # What TensorRT-RTX answers
        answer = list[str]()
        if (build := self.build) is not None:
            built = "built" if build.built else "not built"
            board = "" if build.built is None else f", {built} for SM{self.options.sm}"
            parsed = "parsed" if build.parsed else "not parsed"
            version = f"TensorRT-RTX {build.version}, on this CPU"
            answer.append(f"{version}: {parsed}{board}")
            if cut := build.cut:
                answer.append(f"cut at {len(cut)} plugins: {', '.join(cut[:5])}")
        reason = self.refusal or self.miscomputed
        error = None if reason is None else PreconditionError(reason)
        tables, lines = [findings] if rows else [], (self.headline, *answer)
        return View(self.headline, tables, lines, error=error)

    @property
    def status(self) -> Status:
        """``warning`` if there are findings of any severity."""
        return "warning" if super().status == "ok" and self.findings else super().status

    @property
    def headline(self) -> str:
        """The number of findings of each severity, by our own rules and tables."""
        counts = Counter(finding.severity for finding in self.findings)
        always = ("error", "warning")
        parts = [
            plural(counts[name], name) if name in always else f"{counts[name]} {name}"
            for name in SEVERITIES
            if counts[name] or name in always
        ]
        asked = self.options.target, self.options.target_version
        runtime = " ".join(filter(None, asked))
        return (
            f"{self.model.name} for {runtime}: {', '.join(parts)}"
            " (our own rules and operator tables)"
        )

    def summary(self) -> tuple[RuleSummary, ...]:
        """Return one row per severity and rule, in the order of the findings."""
        rows: dict[tuple[Severity, str], list[LintFinding]] = {}
        for finding in self.findings:
            rows.setdefault((finding.severity, finding.rule), []).append(finding)
        return tuple(
            RuleSummary(*key, len(of_rule), of_rule[0].node, of_rule[0].message)
            for key, of_rule in rows.items()
        )

    def to_json(self) -> object:
        """Return the target, the findings, and the answer of TensorRT-RTX."""
        return {
            "target": self.options.target,
            "findings": self.findings,
            "tensorrt_rtx": self.build,
        }


def lint(
    model: str | Path, options: LintOptions | None = None, listener: Listener = SILENT
) -> LintResult:
    """Check a graph for the runtime that will run it.

    The model is an ONNX file or the name of one that ships. For onnxruntime it is
    opened too, if no rule says that it would be refused.

    Raises:
        GraphError: The model does not exist, or onnxruntime crashes on it.
        ProviderError: The provider is not available.
        RecipeError: The target does not exist.
        MissingExtraError: TensorRT-RTX is asked for and not installed.
    """
    # Rules and operator tables of the target
    path = model_path(model)
    loaded = graph.load(path)
    options = with_target(loaded, options or LintOptions())
    target, provider = _target_of(options), options.runs_on
    findings = target.lint(loaded)
    if provider.native != CPU.native:  # the list of kernels is the CPU's
        findings = tuple(e for e in findings if e.rule != "kernel")
    # A graph that the rules refuse is not opened
    if not any(finding.severity == "error" for finding in findings):
        if target.runs_in == CPU.name:
            try_first(loaded, path.name, listener=listener, provider=provider)
        findings = worst_first((*findings, *target.read_back(loaded, provider)))
    build = check(loaded, options.sm) if options.trt_check else None
    return LintResult(path, options, findings, build)


def with_target(model: ir.Model, options: LintOptions) -> LintOptions:
    """Return options with a target: the user's, the plan's, or tensorrt; or refuse."""
    if options.target is None:
        plan = None if options.of_tensorrt else plan_of(model)
        written_for = "" if plan is None else plan.target
        options = dataclasses.replace(options, target=written_for or "tensorrt")
    if options.runs_on != CPU and not _target_of(options).runs_in:
        raise RecipeError(
            f"lint for {options.target} opens no session: --provider is of no use"
        )
    return options


def _target_of(options: LintOptions) -> Target:
    """Return the target whose rules judge the graph; a RecipeError if there is none."""
    if options.target_version is None:
        return TARGETS.parse(options.target or "tensorrt")
    try:
        return TensorRT(version=options.target_version)
    except ValueError as reason:
        raise RecipeError(f"--target-version: {reason}") from reason


def lint_written(
    model: ir.Model, passes: Sequence[Pass], output: Path, asked: str | None
) -> LintResult | None:
    """Lint a graph for the target that passes wrote int8 for; None without int8."""
    targets = [step.target for step in passes if isinstance(step, QuantizeInt8)]
    if not targets:
        return None
    options = LintOptions(target=targets[-1])
    findings = _target_of(options).lint(with_own_domains(model))
    return LintResult(Path(output.name), options, findings, asked=asked is not None)
