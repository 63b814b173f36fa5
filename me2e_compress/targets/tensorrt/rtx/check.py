"""Parse and build a graph, and hold the result against its quantization plan."""

import dataclasses
import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import GraphError, MissingExtraError, RecipeError
from me2e_compress.quantization.plan import INT8, QuantPlan, plan_of
from me2e_compress.targets.tensorrt.rtx.built_layers import (
    Kernel,
    read_kernels,
    without_int8,
)
from me2e_compress.targets.tensorrt.rtx.cut import cut

SM = (75, 80, 86, 89, 120, 121)
"""GPU generations that TensorRT-RTX 1.7 builds for: Turing, Ampere, Ada, Blackwell."""

EXTRA = "trt-check"


@dataclasses.dataclass(frozen=True)
class BuildResult:
    """What TensorRT-RTX made of a graph.

    Attributes:
        version: of TensorRT-RTX.
        cut: nodes that were cut out, because it has no plugin library.
        parsed: whether the parser took the graph.
        built: whether the builder did; None if it was not asked.
        layers: of the parsed network.
        errors: what parser and builder objected to.
        kernels: convolutions and products of the built plan.
        missing: convolutions (Conv) that the graph's quantization plan makes int8 and
            that no int8 kernel computes; None if the graph carries no plan, or was not
            built. What becomes of products and deconvolutions is for the builder to
            choose.
    """

    version: str
    cut: tuple[str, ...]
    parsed: bool
    built: bool | None
    layers: int
    errors: tuple[str, ...]
    kernels: tuple[Kernel, ...] = ()
    missing: tuple[str, ...] | None = None

    @property
    def passed(self) -> bool:
        """Whether everything that was asked went well."""
        return self.parsed and self.built is not False and not self.missing


def check(model: ir.Model, sm: int = 86, *, build: bool = True) -> BuildResult:
    """Let TensorRT-RTX parse a graph and build it, without a GPU.

    A minute and 1 GB for 1,500 nodes and 55 convolutions.

    Args:
        model: the graph; it stays as it is.
        sm: GPU generation to build for, of :data:`SM`.
        build: whether to build, or only parse.

    Raises:
        MissingExtraError: TensorRT-RTX is not installed.
        RecipeError: no such generation.
        GraphError: the parser took its process down; the message has its last line.
        PreconditionError: the graph cannot be cut at a plugin.
    """
    if importlib.util.find_spec("tensorrt_rtx") is None:
        raise MissingExtraError("tensorrt-rtx", EXTRA)
    if sm not in SM:
        listed = ", ".join(str(each) for each in SM)
        raise RecipeError(f"no GPU generation {sm}; there are {listed}")
    ready = model.clone()
    graph.infer_shapes(ready)
    part, gone = cut(ready)
    with tempfile.TemporaryDirectory(prefix="me2e-rtx-") as scratch:
        answer, plan = _ask(part, Path(scratch), sm, build=build)
    kernels = () if plan is None else read_kernels(plan)
    errors = [*answer["errors"], *answer["log"]] if not _went_well(answer) else []
    return BuildResult(
        str(answer["version"]),
        gone,
        bool(answer["parsed"]),
        answer["built"],
        int(answer["layers"]),
        tuple(" ".join(str(each).split()) for each in errors),
        kernels,
        _missing(plan_of(model), kernels) if plan is not None else None,
    )


def _ask(
    part: ir.Model, scratch: Path, sm: int, *, build: bool
) -> tuple[dict[str, Any], bytes | None]:
    model, answer, plan = (scratch / name for name in ("m.onnx", "a.json", "plan"))
    graph.save(part, model)
    words = [str(model), str(answer), str(sm), *([str(plan)] if build else [])]
    done = subprocess.run(
        [sys.executable, "-m", "me2e_compress.targets.tensorrt.rtx.rtx_main", *words],
        capture_output=True,
        text=True,
        check=False,
    )
    if not answer.is_file():
        last = done.stderr.strip().splitlines()[-1:] or ["it said nothing"]
        raise GraphError(
            f"TensorRT-RTX ended with code {done.returncode} on the graph: {last[0]}"
        )
    found = json.loads(answer.read_text(encoding="utf-8"))
    return found, plan.read_bytes() if plan.is_file() else None


def _went_well(answer: dict[str, Any]) -> bool:
    return bool(answer["parsed"]) and answer["built"] is not False


def _missing(
    plan: QuantPlan | None, kernels: tuple[Kernel, ...]
) -> tuple[str, ...] | None:
    if plan is None:
        return None
    wanted = [
        each.node or f"node_of_{each.output}"  # what the parser calls it
        for each in plan.decisions
        if each.dtype == INT8 and each.op == "Conv"
    ]
    return without_int8(wanted, kernels)
