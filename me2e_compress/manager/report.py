"""What a run of the manager did, for people and for programs."""

import dataclasses
import importlib.metadata
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import (
    LOWER_BOUND,
    Table,
    format_gmacs,
    format_mb,
    table,
)
from me2e_compress.graph.summary import Size
from me2e_compress.passes.base import Pass

UNSTEADY = (
    "not judged: on these inputs rounding alone moves the output as far; "
    "recorded frames (--frames) tell more"
)
RANDOM = "not judged: the graph that came in gives another output at every run"

_PACKAGES = ("me2e-compress", "onnx", "onnx-ir", "onnxruntime", "numpy")


@dataclasses.dataclass(frozen=True)
class Step:
    """What one pass did.

    Attributes:
        name: the pass.
        text: the pass with its options; as a pipeline writes it.
        exact: whether it promises the same outputs.
        changes: places it changed.
        seconds: CPU time of its transaction: clone, pass and contract checks, without
            the numeric check of exact passes.
        before: the graph's size before.
        after: the graph's size after.
        notes: what it has to say.
    """

    name: str
    text: str
    exact: bool
    changes: int
    seconds: float
    before: Size
    after: Size
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class LossyPass:
    """A pass that promises nothing of the outputs, as it was run.

    Attributes:
        applied: the pass.
        before: the graph that it was given, shapes inferred.
        changes: places it changed.
    """

    applied: Pass
    before: ir.Model
    changes: int


@dataclasses.dataclass(frozen=True)
class Verification:
    """One numeric check of a stretch of exact passes.

    Attributes:
        passes: the passes it covers.
        inputs: ``recorded`` frames, ``synthetic`` seeded inputs, or ``none``.
        errors: largest relative error, by output: max|a-b|/max|a|; empty if not
            measured.
        tolerances: what was allowed.
        skipped: why nothing was measured; or None.
        unsteady: outputs that rounding alone moves as far: on these inputs they
            differ, and that says nothing about the passes.
        random: outputs that differ at every run; of the graph before, too.
        sizes: of open dimensions; drawn to run the graphs at.
        remarks: what else is to be known: where onnxruntime's own optimizations change
            an output, and the graphs were compared without them.
    """

    passes: tuple[str, ...]
    inputs: str
    errors: dict[str, float]
    tolerances: dict[str, float]
    skipped: str | None = None
    unsteady: tuple[str, ...] = ()
    random: tuple[str, ...] = ()
    sizes: tuple[dict[str, int], ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def judged(self) -> tuple[str, ...]:
        """The outputs that say something about the passes."""
        left_out = {*self.unsteady, *self.random}
        return tuple(name for name in self.errors if name not in left_out)

    @property
    def passed(self) -> bool:
        """Whether every output that is judged stayed within its tolerance."""
        return all(self.errors[n] <= self.tolerances[n] for n in self.judged)

    @property
    def unproven(self) -> str | None:
        """Why no output says that the passes are exact; None where one does."""
        if self.skipped is not None:
            return self.skipped
        return None if self.judged else self.left_out

    @property
    def left_out(self) -> str:
        """Which outputs say nothing of the passes, and why; empty where all do."""
        why = {
            "another at every run": self.random,
            "rounding alone moves it as far": self.unsteady,
        }
        return "; ".join(f"{', '.join(n)}: {reason}" for reason, n in why.items() if n)

    @property
    def inputs_text(self) -> str:
        """The kind of inputs with drawn sizes: ``synthetic, n=2 and n=3``."""
        drawn = " and ".join(
            ", ".join(f"{name}={size}" for name, size in each.items())
            for each in self.sizes
        )
        return f"{self.inputs}, {drawn}" if drawn else self.inputs


@dataclasses.dataclass(frozen=True, repr=False)
class Report:
    """The compressed model and how it came to be.

    Attributes:
        model: the graph after the last pass.
        pipeline: the passes as text; feeding it to ``--passes`` repeats the run.
        steps: pass by pass.
        verifications: the numeric checks, in order.
        lossy: the passes that are not exact, in order, to be judged by what they did.
        read_as: what was changed when the file was read; empty if nothing was.
    """

    model: ir.Model
    pipeline: str
    steps: tuple[Step, ...]
    verifications: tuple[Verification, ...]
    lossy: tuple[LossyPass, ...] = ()
    read_as: str = ""

    @property
    def unproven(self) -> tuple[Verification, ...]:
        """The checks of exact passes in which no output could be judged."""
        return tuple(each for each in self.verifications if each.unproven is not None)

    def tables(self) -> tuple[Table, ...]:
        """Return pass by pass what changed, and how exact passes were checked."""
        return _steps_table(self.steps), _verification_table(self.verifications)

    def record(self, source: Path, output: Path) -> dict[str, object]:
        """Give everything but the weights, ready for JSON; both files are hashed."""
        files = [
            {"file": file.name, "sha256": graph.sha256_of(file)}
            for file in (source, output)
        ]
        return {
            "source": files[0] | {"read_as": self.read_as},
            "output": files[1],
            "pipeline": self.pipeline,
            "steps": [dataclasses.asdict(step) for step in self.steps],
            "verifications": [
                dataclasses.asdict(each) | {"proven": each.unproven is None}
                for each in self.verifications
            ],
            "versions": versions(),
        }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide the result."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed as a package"
    return versions


def _steps_table(steps: Sequence[Step]) -> Table:
    """Show pass by pass what changed and what it cost, and what the passes say."""
    notes = [f"{step.name}: {note}" for step in steps for note in step.notes]
    partly = any(step.after.unknown_macs_nodes for step in steps)
    return table(
        "Pass by pass",
        ("pass", "changes", "nodes", "weights MB", "GMACs", "CPU s"),
        [
            (
                step.name,
                str(step.changes),
                f"{step.before.counted_nodes} → {step.after.counted_nodes}",
                f"{format_mb(step.before.weight_bytes)} →"
                f" {format_mb(step.after.weight_bytes)}",
                format_gmacs(step.after.macs, step.after.unknown_macs_nodes),
                f"{step.seconds:.2f}",
            )
            for step in steps
        ],
        LOWER_BOUND if partly else "",
        details="\n".join(notes),
    )


def _verification_table(verifications: Iterable[Verification]) -> Table:
    """Show how far exact passes moved the outputs."""
    rows, notes = list[tuple[str, ...]](), dict[str, None]()
    for check in verifications:
        names, inputs = ", ".join(check.passes), check.inputs_text
        if check.skipped is not None:
            rows.append((names, f"not proven: {check.skipped}", "", "", ""))
            continue
        for worst in sorted(check.judged, key=lambda name: -check.errors[name])[:1]:
            error, allowed = check.errors[worst], check.tolerances[worst]
            rows.append((names, inputs, worst, f"{error:.1e}", f"{allowed:.0e}"))
        for listed, why in ((check.unsteady, UNSTEADY), (check.random, RANDOM)):
            if listed:
                rows.append((names, inputs, ", ".join(listed), "not judged", ""))
                notes[why] = None
        notes |= dict.fromkeys(check.remarks)
    return table(
        "Exact passes, checked by running both graphs",
        ("passes", "inputs", "worst output", "max|a-b|/max|a|", "allowed"),
        rows,
        "\n".join(notes),
        words=3,
    )
