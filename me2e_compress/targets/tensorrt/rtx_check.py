"""Check graphs with the ONNX parser and builder of TensorRT-RTX, on a CPU.

Its parser is of the same family as TensorRT's, and its builder compiles for a GPU that
is not present. It is not TensorRT: timings and fusions do not carry over, and it lacks
the plugin library, so the graph is cut at plugins.
"""

import dataclasses
import importlib.util
import json
import tempfile
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import (
    BrokenPackageError,
    GraphError,
    MissingExtraError,
    PreconditionError,
    RecipeError,
)
from me2e_compress.graph import rewrite
from me2e_compress.graph.nodes import is_plugin
from me2e_compress.runtime.children import run_script

# GPU generations that TensorRT-RTX 1.7 builds for: Turing, Ampere, Ada, Blackwell
SM = (75, 80, 86, 89, 120, 121)

EXTRA = "trt-check"


@dataclasses.dataclass(frozen=True)
class BuildResult:
    """The result of TensorRT-RTX for a graph.

    Attributes:
        cut: nodes that were cut out, because it has no plugin library.
        built: whether the builder accepted the graph; None if it was not run.
    """

    version: str
    cut: tuple[str, ...]
    parsed: bool
    built: bool | None
    layers: int
    errors: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether every step that was run succeeded."""
        return self.parsed and self.built is not False

    @property
    def refusal(self) -> str:
        """What is said first of a graph that did not pass."""
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
        raise RecipeError(f"no GPU generation {sm}; there are {str(SM)[1:-1]}")
    # Cut out the plugins, and build the rest in another process.
    ready = model.clone()
    graph.infer_shapes(ready)
    part, gone = cut(ready)
    with tempfile.TemporaryDirectory(prefix="me2e-rtx-") as scratch:
        file, answer_file = Path(scratch, "m.onnx"), Path(scratch, "a.json")
        graph.save(part, file)
        words = [str(file), str(answer_file), str(sm), "build" if build else "parse"]
        done = run_script(Path(__file__).with_name("rtx_main.py"), words)
        # No answer file means that the process crashed
        if not answer_file.is_file():
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            if last.startswith(("ImportError", "ModuleNotFoundError")):
                raise BrokenPackageError("tensorrt_rtx", EXTRA, last)
            code = f"TensorRT-RTX ended with code {done.returncode} on the graph"
            raise GraphError(f"{code}: {last}")
        answer = json.loads(answer_file.read_text(encoding="utf-8"))
    passed = answer["parsed"] and answer["built"] is not False
    errors = [] if passed else [*answer["errors"], *answer["log"]]
    return BuildResult(
        str(answer["version"]),
        gone,
        bool(answer["parsed"]),
        answer["built"],
        int(answer["layers"]),
        tuple(" ".join(str(each).split()) for each in errors),
    )


# Operators that TensorRT supports by its own plugins, and TensorRT-RTX does not
LACKING = frozenset({"DeformConv", "NonMaxSuppression", "NonZero", "RoiAlign"})


def cut(model: ir.Model) -> tuple[ir.Model, tuple[str, ...]]:
    """Cut a graph at plugins: their outputs become inputs, their inputs outputs.

    Nodes with a local function are not plugins: the parser reads the function. Types
    and shapes must be known. Returns the copy, and the names of the nodes that were cut
    out.
    """
    copy = model.clone()
    copy.metadata_props.clear()  # it names inputs and outputs that change
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
    """Remove a node: its outputs become graph inputs, what it reads graph outputs."""
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
