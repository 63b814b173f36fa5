"""What users report that TensorRT gets wrong: the pattern, the versions, the thread.

Read on 2026-11-24. A row says what was reported, not what NVIDIA admits or what was run
here: no TensorRT runs in our tests. A thread that is open when no later version is
known to be better stands for later versions, too.
"""

import dataclasses
from collections.abc import Callable, Iterator

import onnx_ir as ir

from me2e_compress.graph import is_standard, nodes_of, opset_of
from me2e_compress.targets.base import LintFinding, LintRule, Severity, name_of
from me2e_compress.targets.tensorrt.lint import reported_patterns as patterns
from me2e_compress.targets.tensorrt.lint.support_matrix import Version, version_of

WRONG: Severity = "reported wrong"
SLOW: Severity = "reported slow"
REFUSED: Severity = "reported refused"


@dataclasses.dataclass(frozen=True)
class ReportedFault:
    """One thing that users report of some versions.

    Attributes:
        rule: its id.
        severity: whether the engine answers wrongly, is slow, or is not built.
        op_types: the operators at which it is looked for.
        found: whether a node of them is such a place; the opset is the graph's.
        first: the oldest version that it was reported of; empty if none is told.
        last: the newest; empty if it is the oldest, too.
        open: whether versions after the last are taken to have it.
        source: the thread, or the file of a repository.
        what: what is reported.
        remedy: what to do about it.
        once: whether the graph is told at its first such node, not each of them.
    """

    rule: str
    severity: Severity
    op_types: tuple[str, ...]
    found: Callable[[ir.Node, int], bool]
    first: str
    last: str
    open: bool
    source: str
    what: str
    remedy: str
    once: bool = False

    def concerns(self, version: Version | None) -> bool:
        """Return whether a version may have it; every report concerns None."""
        if version is None or not self.first:
            return True
        if version < version_of(self.first):
            return False
        return self.open or version <= version_of(self.last or self.first)

    @property
    def versions(self) -> str:
        """The versions it was reported of, in words."""
        if not self.first:
            return "version not told"
        if self.last:
            return f"TensorRT {self.first} to {self.last}"
        return f"TensorRT {self.first}" + " on" * self.open

    @property
    def message(self) -> str:
        """All that a finding says."""
        return f"{self.what} ({self.versions}, {self.source}): {self.remedy}"


_SPARSEDRIVE = "Wanglaoban3/sparsedrive-tensorrt-deploy-implement"

FAULTS: tuple[ReportedFault, ...] = (
    ReportedFault(
        "grid-sample-mode", WRONG, ("GridSample",), patterns.new_words_for_modes,
        # reported of 10.13 and 11.1; so are the parser's sources from 10.1 on
        "10.1", "11.1", True, "NVIDIA/TensorRT#4646, onnx/onnx-tensorrt#1060",
        "opset 20 calls bilinear linear and bicubic cubic; the parser knows the old"
        " words alone and samples the nearest pixel",
        "leave the attribute out, for linear, or export with opset 16 to 19",
    ),
    ReportedFault(
        "decomposed-attention", WRONG, ("Mul", "MatMul", "Einsum"),
        patterns.decomposed_attention,
        "10.14", "11.1", True, "NVIDIA/TensorRT#4813",
        "deformable attention decomposed into GridSample answers wrongly without a"
        " word; one report is of 10.13 with a dynamic batch",
        "fuse-operators and translate-plugins make it the plugin's node",
    ),
    ReportedFault(
        "float32-grid-sample", WRONG, ("GridSample",), patterns.float32_island,
        "10.14", "", True, "pytorch/TensorRT#4074",
        "a GridSample kept in float32 within a float16 graph answers wrongly",
        "sample in float16, or keep what is around it in float32, too",
    ),
    ReportedFault(
        "clip-bound", WRONG, ("Clip",), patterns.clipped_product,
        "10.12", "10.13", True, "NVIDIA/TensorRT#4606",
        "MatMul, Add and a Clip that begins at 0 lose the upper bound: ReLU6 becomes"
        " ReLU",
        "write Max and Min, or a bound of the Clip that is computed",
    ),
    ReportedFault(
        "resize-of-if", WRONG, ("Resize",), patterns.conditional_resize,
        "11.1", "11.2", True, "NVIDIA/TensorRT#4846",
        "a Resize of the Transpose of what an If gives answers wrongly",
        "fold the If (fold-constants with fixed shapes), or transpose inside it",
    ),
    ReportedFault(
        "half-attention", WRONG, ("MatMul",), patterns.half_attention,
        "10.16", "", True, "NVIDIA/TensorRT#4837",
        "fused attention in float16 or bfloat16 answers wrongly on GPUs of SM 120",
        "keep it in float32 there, or compare the engine with the graph",
    ),
    ReportedFault(
        "attention-keys", WRONG, ("Softmax",), patterns.more_keys_than_float16,
        "", "", True, "tier4/autoware-ml#95",
        f"fused attention in float16 over more than {patterns.LARGEST_FLOAT16:,} keys"
        " sums beyond float16 and gives NaN",
        "keep this attention in float32 or bfloat16",
    ),
    ReportedFault(
        "half-variance", WRONG, ("ReduceMean",), patterns.half_squares,
        "8.5", "10.10", True, "NVIDIA/TensorRT#2564, NVIDIA/TensorRT#4493",
        "the variance of a layer normalization overflows in float16",
        "fuse-basic writes LayerNormalization from opset 17 on, which TensorRT"
        " computes in float32; or keep it in float32",
    ),
    ReportedFault(
        "modulated-convolution", WRONG,
        ("ModulatedDeformableConv2dTRT", "ModulatedDeformableConv2dTRT2"),
        patterns.plugin,
        "10.3", "", True, "NVIDIA/DL4AGX#85, NVIDIA/DL4AGX#94",
        "BEVFormer_tensorrt's plugin as it was answers wrongly (mAP 0)",
        "build the plugin with the patch of NVIDIA/DL4AGX#94",
    ),
    ReportedFault(
        "int8-product", REFUSED, ("Gemm", "MatMul"), patterns.int8_product,
        "8.6", "", False, f"{_SPARSEDRIVE}, docs/OPTIMIZATION_SUMMARY.md",
        "int8 outside of the convolutions of a driving stack was not built"
        " (chooseHigherPrecision assertion)",
        "if yours fails so, keep the heads in float: --scheme feature-ext",
        once=True,
    ),
    ReportedFault(
        "bfloat16-deconvolution", REFUSED, ("ConvTranspose",),
        patterns.bfloat16_deconvolution,
        "11.0", "11.2", True,
        "NVIDIA/TensorRT#4829, rerun-io/examples-monorepo#106",
        "ConvTranspose in bfloat16 has no kernel",
        "cast around it to float16 or float32",
    ),
    ReportedFault(
        "broadcast-product", SLOW, ("MatMul",), patterns.broadcast_product,
        "8.6", "", False, f"{_SPARSEDRIVE}, docs/OPTIMIZATION_SUMMARY.md",
        "a MatMul of many axes that repeats both sides gets the slowest kernel: 5.8"
        " MFLOP at five places took 14.07 of 83 ms on Orin, 0.57 as products of three"
        " axes",
        "reshape both sides to three axes",
    ),
    ReportedFault(
        "strided-softmax", SLOW, ("Softmax",), patterns.strided_softmax,
        "", "", True, f"{_SPARSEDRIVE}, TECH_DETAILS.md",
        "a Softmax over a long axis that is not the last: 3 to 4 ms over 7,200"
        " elements, 0.2 over the last axis",
        "transpose before and after it",
    ),
)  # fmt: skip


def reported(version: Version | None) -> LintRule:
    """Return the rule that finds what is reported of a version, None: of any."""
    rows: dict[str, list[ReportedFault]] = {}
    for each in FAULTS:
        if each.concerns(version):
            for op_type in each.op_types:
                rows.setdefault(op_type, []).append(each)

    def rule(model: ir.Model) -> Iterator[LintFinding]:
        opset, told = opset_of(model), set[str]()
        for node in nodes_of(model):
            for row in rows.get(node.op_type, ()):
                # an operator of another domain is another one
                of_onnx = row.found is not patterns.plugin
                if row.rule in told or (of_onnx and not is_standard(node)):
                    continue
                if not row.found(node, opset):
                    continue
                if row.once:
                    told.add(row.rule)
                yield LintFinding(row.severity, row.rule, name_of(node), row.message)

    return rule
