"""What a run of the manager did, for people and for programs."""

import dataclasses
import importlib.metadata
import platform
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import Size

_PACKAGES = ("me2e-compress", "onnx", "onnx-ir", "onnxruntime", "numpy")


@dataclasses.dataclass(frozen=True)
class Step:
    """What one pass did.

    Attributes:
        name: the pass.
        text: the pass with its options, as a pipeline writes it.
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


@dataclasses.dataclass(frozen=True)
class Verification:
    """One numeric check of a stretch of exact passes.

    Attributes:
        passes: the passes it covers.
        inputs: ``recorded`` frames, ``synthetic`` seeded inputs, or ``none``.
        errors: output name -> max|a-b|/max|a|; empty if not measured.
        tolerances: output name -> what was allowed.
        skipped: why nothing was measured, or None.
        unsteady: outputs that rounding alone moves as far on these inputs: they
            differ, and that says nothing about the passes.
    """

    passes: tuple[str, ...]
    inputs: str
    errors: dict[str, float]
    tolerances: dict[str, float]
    skipped: str | None = None
    unsteady: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Report:
    """The compressed model and how it came to be.

    Attributes:
        model: the graph after the last pass.
        pipeline: the passes as text; feeding it to ``--passes`` repeats the run.
        steps: pass by pass.
        verifications: the numeric checks, in order.
    """

    model: ir.Model
    pipeline: str
    steps: tuple[Step, ...]
    verifications: tuple[Verification, ...]

    def record(self, source: Path, output: Path) -> dict[str, object]:
        """Give everything but the weights, ready for JSON.

        Args:
            source: the file that was compressed.
            output: the file that was written; both are hashed as they are on disk.
        """
        return {
            "source": {"file": source.name, "sha256": graph.sha256_of(source)},
            "output": {"file": output.name, "sha256": graph.sha256_of(output)},
            "pipeline": self.pipeline,
            "steps": [dataclasses.asdict(step) for step in self.steps],
            "verifications": [dataclasses.asdict(v) for v in self.verifications],
            "versions": versions(),
        }


def versions() -> dict[str, str]:
    """Name the versions that decide the result."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed as a package"
    return found
