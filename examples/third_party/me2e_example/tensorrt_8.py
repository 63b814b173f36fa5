"""TensorRT 8, which reads opsets up to 17."""

import dataclasses
from collections.abc import Iterator
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.targets import LintFinding, LintRule, error
from me2e_compress.targets.tensorrt import TensorRT

NEWEST_OPSET = 17
"""TensorRT 8.6, release notes of its ONNX parser."""


@dataclasses.dataclass(frozen=True)
class TensorRT8(TensorRT):
    """Int8 as for TensorRT; the lint also refuses newer opsets."""

    name: ClassVar[str] = "tensorrt-8"

    def lint_rules(self) -> tuple[LintRule, ...]:
        """Add one rule to TensorRT's."""
        return (*super().lint_rules(), newer_opset)


def newer_opset(model: ir.Model) -> Iterator[LintFinding]:
    """Find out whether the graph is too new."""
    opset = model.opset_imports.get("", 0)
    if opset > NEWEST_OPSET:
        yield error("opset", None, f"opset {opset}, the newest is {NEWEST_OPSET}")
