"""Check graphs with the ONNX parser and builder of TensorRT-RTX, on a CPU.

Its parser is of the same family as TensorRT's, and its builder compiles for a GPU that
is not present. It is not TensorRT: timings and fusions do not carry over, and it lacks
the plugin library, so the graph is cut at plugins.

A built plan is a binary file with readable text for each kernel, in an undocumented
form. It is read only to confirm the quantization plan: if the form changes, no kernels
are found, and that is reported.
"""

import dataclasses
import importlib.util
import json
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import (
    BrokenPackageError,
    GraphError,
    MissingExtraError,
    PreconditionError,
    RecipeError,
)
from me2e_compress.graph import rewrite
from me2e_compress.graph.nodes import is_plugin
from me2e_compress.quantization.decision import INT8, plan_of
from me2e_compress.runtime.children import run_script

SM = (75, 80, 86, 89, 120, 121)
"""GPU generations that TensorRT-RTX 1.7 builds for: Turing, Ampere, Ada, Blackwell."""

EXTRA = "trt-check"

_KERNEL = re.compile(
    r"(corrltn|deconvolution|fully_connected)=\{ name=\"([^\"]+)\" output=\{([^}]*)\}"
    r" input=\{([^}]*)\}"
)
_TENSOR = re.compile(r'name="([^"]+)"[^}]*?(?:\{[^}]*\}[^}]*?)*type=(\w+) \}')
_WORD = re.compile(r'"([^"]+)"')
_KINDS = {
    "corrltn": "convolution",
    "deconvolution": "deconvolution",
    "fully_connected": "product",
}


@dataclasses.dataclass(frozen=True)
class Kernel:
    """One convolution or matrix product of a built plan.

    ``nodes`` are the ONNX nodes that it computes, possibly several merged ones;
    ``operands`` the element types of its first two operands, ``?`` if unknown.
    """

    kind: str
    nodes: tuple[str, ...]
    operands: tuple[str, ...]

    @property
    def is_int8(self) -> bool:
        """Whether both operands are int8."""
        return self.operands == ("int8", "int8")


@dataclasses.dataclass(frozen=True)
class BuildResult:
    """The result of TensorRT-RTX for a graph.

    Attributes:
        cut: nodes that were cut out, because it has no plugin library.
        built: whether the builder accepted the graph; None if it was not run.
        kernels: convolutions and products of the built plan.
        missing: convolutions (Conv) that the graph's quantization plan makes int8 and
            that no int8 kernel computes; None if the graph has no plan, or was not
            built. Products and deconvolutions are left to the builder's choice.
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
        """Whether every step that was run succeeded."""
        return self.parsed and self.built is not False and not self.missing

    @property
    def refusal(self) -> str:
        """What is said first of a graph that did not pass."""
        if self.missing:
            return (
                f"{len(self.missing)} convolutions that the plan makes int8 have no"
                f" int8 kernel, {self.missing[0]} first"
            )
        first = self.errors[0] if self.errors else "it does not say why"
        return f"TensorRT-RTX refuses it: {first}"


def check(model: ir.Model, sm: int = 86, *, build: bool = True) -> BuildResult:
    """Parse and build a graph with TensorRT-RTX, without a GPU.

    It takes a minute and 1 GB for 1,500 nodes and 55 convolutions. ``sm`` is one of
    :data:`SM`.

    Raises:
        MissingExtraError: TensorRT-RTX is not installed.
        BrokenPackageError: it is installed, but cannot be imported.
        RecipeError: no such GPU generation.
        GraphError: the parser crashed; the message has its last line.
        PreconditionError: the graph cannot be cut at a plugin.
    """
    if importlib.util.find_spec("tensorrt_rtx") is None:
        raise MissingExtraError("tensorrt-rtx", EXTRA)
    if sm not in SM:
        listed = ", ".join(str(each) for each in SM)
        raise RecipeError(f"no GPU generation {sm}; there are {listed}")
    # Cut out the plugins, and build the rest in another process.
    ready = model.clone()
    graph.infer_shapes(ready)
    part, gone = cut(ready)
    with tempfile.TemporaryDirectory(prefix="me2e-rtx-") as scratch:
        answer, plan = _ask(part, Path(scratch), sm, build=build)
    # Confirm that the planned nodes are int8 kernels.
    kernels = () if plan is None else read_kernels(plan)
    planned = None if plan is None else plan_of(model)
    missing = None
    if planned is not None:
        wanted = [
            each.node or f"node_of_{each.output}"  # what the parser calls it
            for each in planned.decisions
            if each.dtype == INT8 and each.op == "Conv"
        ]
        missing = without_int8(wanted, kernels)
    well = answer["parsed"] and answer["built"] is not False
    errors = [] if well else [*answer["errors"], *answer["log"]]
    return BuildResult(
        str(answer["version"]),
        gone,
        bool(answer["parsed"]),
        answer["built"],
        int(answer["layers"]),
        tuple(" ".join(str(each).split()) for each in errors),
        kernels,
        missing,
    )


def _ask(
    part: ir.Model, scratch: Path, sm: int, *, build: bool
) -> tuple[dict[str, Any], bytes | None]:
    model, answer, plan = (scratch / name for name in ("m.onnx", "a.json", "plan"))
    graph.save(part, model)
    words = [str(model), str(answer), str(sm), *([str(plan)] if build else [])]
    done = run_script(Path(__file__).with_name("rtx_main.py"), words)
    # No answer file means that the process crashed.
    if not answer.is_file():
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        if last[0].startswith(("ImportError", "ModuleNotFoundError")):
            raise BrokenPackageError("tensorrt_rtx", EXTRA, last[0])
        raise GraphError(
            f"TensorRT-RTX ended with code {done.returncode} on the graph: {last[0]}"
        )
    found = json.loads(answer.read_text(encoding="utf-8"))
    return found, plan.read_bytes() if plan.is_file() else None


def read_kernels(plan: bytes) -> tuple[Kernel, ...]:
    """Find the convolutions and products in the text of a plan."""
    text = plan.decode("latin1")
    types = dict(_TENSOR.findall(text))
    return tuple(
        Kernel(
            _KINDS[kind],
            tuple(name.split("+")),
            tuple(types.get(word, "?") for word in _WORD.findall(operands)[:2]),
        )
        for kind, name, _, operands in _KERNEL.findall(text)
    )


def without_int8(nodes: Iterable[str], kernels: Iterable[Kernel]) -> tuple[str, ...]:
    """Return the nodes that no int8 kernel of the plan computes."""
    done = {name for kernel in kernels if kernel.is_int8 for name in kernel.nodes}
    return tuple(name for name in nodes if name not in done)


LACKING = frozenset({"DeformConv", "NonMaxSuppression", "NonZero", "RoiAlign"})
"""Operators that TensorRT supports by its own plugins, and TensorRT-RTX does not."""


def cut(model: ir.Model) -> tuple[ir.Model, tuple[str, ...]]:
    """Cut a graph at plugins: their outputs become inputs, their inputs outputs.

    Nodes with a local function are not plugins: the parser reads the function. Types
    and shapes must be known. Returns the copy, and the names of the nodes that were cut
    out.
    """
    copy = model.clone()
    copy.metadata_props.clear()  # it speaks of inputs and outputs that change
    gone = [
        node
        for node in copy.graph
        if (
            node.op_identifier() not in copy.functions
            if is_plugin(node)
            else node.op_type in LACKING
        )
    ]
    names = tuple(node.name or str(node.outputs[0].name) for node in gone)
    for node in gone:
        _detach(copy.graph, node)
    rewrite.sweep(copy)
    return copy, names


def _detach(where: ir.Graph, node: ir.Node) -> None:
    for value in node.outputs:
        if value.is_graph_output():
            where.outputs.remove(value)
        if not value.uses():
            continue
        # A new graph input needs a type and a shape.
        if value.dtype is None or graph.static_shape(value) is None:
            raise PreconditionError(
                f"{node.op_type} {node.name!r}: the type or shape of its output"
                f" {value.name} is not known, so the graph cannot be cut there"
            )
        name = str(value.name)
        value.name = f"{name}_cut"
        port = ir.Value(name=name, shape=value.shape, type=value.type)
        value.replace_all_uses_with(port)
        where.inputs.append(port)
    # What the node read must still be computed.
    for index, read in enumerate(node.inputs):
        computed = read is not None and read.producer() is not None
        if read is not None and computed and not read.is_graph_output():
            where.outputs.append(read)
        node.replace_input_with(index, None)
    where.remove(node)
