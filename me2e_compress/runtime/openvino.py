"""Run graphs in OpenVINO (2026.4), our kernels inside, through its own Python API."""

import contextlib
import dataclasses
import hashlib
import json
import os
import re
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime as ort
import platformdirs
from onnx import inliner

from me2e_compress import graph, operators
from me2e_compress.base.atomic import write_bytes
from me2e_compress.base.errors import FramesError, GraphError, ProviderError
from me2e_compress.base.extras import missing_module, require_extra
from me2e_compress.graph.files import INLINE_LIMIT_BYTES
from me2e_compress.graph.recurrence import SessionPort
from me2e_compress.graph.shapes import static_shape
from me2e_compress.operators import kernels
from me2e_compress.runtime.children import run_script
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import Engine, Provider
from me2e_compress.runtime.runnable import is_fused, replace_fused, why_endless

if TYPE_CHECKING:
    import openvino as ov

# OpenVINO's property that keeps pairs of quantization as they are, in float; it is not
# among those that it lists
_INT8_OFF = {"LP_TRANSFORMS_MODE": "NO"}
_SCRIPT = Path(__file__).with_name("openvino_opening_main.py")
_UNKNOWN = re.compile(r"No conversion rule found for operations: (.*)")


@dataclasses.dataclass(frozen=True)
class OpenVinoProvider(Provider):
    """OpenVINO on the CPU; int8 where the graph has pairs, ``precision`` for the rest.

    Attributes:
        precision: ``f32``, or ``bf16`` on a CPU that has it.
    """

    name: ClassVar[str] = "openvino"
    native: ClassVar[str] = "OpenVINO"
    engine: ClassVar[str] = "OpenVINO"
    advice: ClassVar[str] = "pip install 'me2e-compress[openvino]'"
    target: ClassVar[str] = "openvino"
    precision: Literal["f32", "bf16"] = "f32"

    def check(self) -> None:
        """Check that it is installed and the CPU has the precision."""
        require_extra("openvino", f"provider {self.name}")
        if self.plugins:
            raise ProviderError(
                f"provider {self.name}: {self.plugins[0]} is for onnxruntime"
            )
        known = new_core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
        if self.precision == "bf16" and "BF16" not in known:
            raise ProviderError(
                f"provider {self.name}: this CPU has no bf16, only {', '.join(known)}"
            )

    def is_installed(self) -> bool:
        """Return whether the package is installed."""
        return not missing_module("openvino")

    def attach(self, options: ort.SessionOptions) -> None:
        """Check that it can run; options of onnxruntime are not its own."""
        self.check()

    def open(
        self, model: ir.Model | Path, threads: int, *, int8_kernels: bool
    ) -> Engine:
        """Open a graph; without ``int8_kernels`` it answers what its nodes say."""
        loaded = graph.load(model) if isinstance(model, Path) else model
        return OpenVino(loaded, self, threads, int8_kernels=int8_kernels)


def new_core(threads: int | None = None) -> "ov.Core":
    """Return a core; with kernels on ``threads`` threads unless that is None."""
    import openvino as ov  # 0.2 s

    core = ov.Core()
    if threads is not None:
        from me2e_compress.operators.kernels.openvino_ops import extensions

        for extension in extensions(threads):
            core.add_extension(extension)
    return core


class OpenVino(Engine):
    """A graph that OpenVINO has compiled.

    Where a kernel refuses the inputs of a node, the bodies run instead from then on,
    which a RuntimeWarning tells once.

    Raises:
        GraphError: OpenVINO cannot run this graph; the message names its operators.
    """

    def __init__(
        self,
        model: ir.Model,
        provider: OpenVinoProvider,
        threads: int,
        *,
        int8_kernels: bool,
    ) -> None:
        if reason := why_endless(model):
            raise GraphError(reason)
        self._model, self._threads = model, threads
        weights = model.graph.initializers
        self._values = [e for e in model.graph.inputs if e.name not in weights]
        self.inputs = _ports(self._values)
        self.outputs = _ports(model.graph.outputs)
        self.metadata = dict(model.metadata_props)
        self._config: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": provider.precision,
            "NUM_STREAMS": 1,
            **({"INFERENCE_NUM_THREADS": threads} if threads else {}),
            **({} if int8_kernels else _INT8_OFF),
        }
        self._compiled = kernels.why_not() is None
        self._open()

    def _open(self) -> None:
        """Compile the graph, with kernels or without."""
        threads = self._threads or os.cpu_count() or 1
        core = new_core(threads if self._compiled else None)
        try:
            proto = for_openvino(self._model, compiled=self._compiled)
            if self._threads == 1 and _dies(proto, self._config):
                self._config["SNIPPETS_MODE"] = "DISABLE"
            self._runner = core.compile_model(_read(core, proto), "CPU", self._config)
        except RuntimeError as error:
            raise GraphError(
                f"OpenVINO cannot run this graph: {_line(error)}"
            ) from error
        self._request = self._runner.create_infer_request()
        # A port answers by each of its names
        self._in, self._out = (
            {name: index for index, port in enumerate(ports) for name in port.names}
            for ports in (self._runner.inputs, self._runner.outputs)
        )

    def run(self, names: Sequence[str], inputs: Mapping[str, Array]) -> list[Array]:
        """Run one inference; arrays that do not fit a port are a FramesError."""
        for value in self._values:
            _check_fit(str(value.name), value, inputs[str(value.name)])
        # An input that nothing reads has no port
        feeds = {
            self._in[name]: array for name, array in inputs.items() if name in self._in
        }
        # Not `infer`: on one thread that ends without a word where a node fails, and
        # answers what the run before did (2026.4.1)
        try:
            self._request.start_async(feeds)
            self._request.wait()
        except RuntimeError as error:
            if self._compiled and "RuntimeError: kernel: " in str(error):
                message = f"{_line(error)}: bodies run instead"
                warnings.warn(message, RuntimeWarning, stacklevel=2)
                self._compiled = False
                self._open()
                return self.run(names, inputs)
            raise GraphError(f"OpenVINO failed: {_line(error)}") from error
        tensors = [self._request.get_output_tensor(self._out[name]) for name in names]
        return [np.array(tensor.data) for tensor in tensors]


def for_openvino(model: ir.Model, *, compiled: bool) -> onnx.ModelProto:
    """Write a graph as OpenVINO reads it: calls of kernels, and no local functions.

    All fused nodes get bodies if the output of one has no fixed shape.
    """
    typed = model
    if compiled and any(map(_is_open, filter(is_fused, graph.nodes_of(model)))):
        typed = model.clone()
        graph.infer_shapes(typed)
        for node in graph.nodes_of(typed):  # probes too, of which no size is known
            if (call := operators.find(node)) is not None:
                operators.set_output(node, *call)
    prepared, _ = replace_fused(typed, compiled=compiled)
    calls = [n for n in graph.nodes_of(prepared) if n.domain == kernels.DOMAIN]
    if any(map(_is_open, calls)):
        prepared, _ = replace_fused(model, compiled=False)
        calls = []
    for node in calls:
        shape = static_shape(node.outputs[0]) or ()
        node.attributes["output_shape"] = ir.AttrInt64s("output_shape", shape)
    proto = ir.to_proto(prepared)
    return inliner.inline_local_functions(proto) if proto.functions else proto


def _is_open(node: ir.Node) -> bool:
    return static_shape(node.outputs[0]) is None


def _dies(proto: onnx.ModelProto, config: Mapping[str, Any]) -> bool:
    """Return whether OpenVINO dies of compiling a graph for one thread."""
    # 2026.4.1 does as it fuses TCP's decoder: each graph is tried apart, once
    content, asked = proto.SerializeToString(deterministic=True), json.dumps(config)
    key = hashlib.sha256(
        content + f"{asked} {metadata.version('openvino')}".encode()
    ).hexdigest()
    folder = platformdirs.user_cache_path("me2e-compress") / "opened"
    verdict = folder / f"openvino-{key}"
    with contextlib.suppress(OSError):
        return verdict.read_bytes() == b"died"
    with tempfile.TemporaryDirectory(prefix="me2e-openvino-") as scratch:
        path = Path(scratch) / "model.onnx"
        path.write_bytes(content)
        died = run_script(_SCRIPT, [str(path), asked]).returncode < 0
    with contextlib.suppress(OSError):  # a home that cannot be written to
        folder.mkdir(parents=True, exist_ok=True)
        write_bytes(verdict, b"died" if died else b"opened")
    return died


def _read(core: "ov.Core", proto: onnx.ModelProto) -> "ov.Model":
    if proto.ByteSize() < INLINE_LIMIT_BYTES:
        return core.read_model(proto.SerializeToString())
    with tempfile.TemporaryDirectory(prefix="me2e-openvino-") as folder:
        path = Path(folder) / "model.onnx"
        onnx.save(proto, path, save_as_external_data=True)
        return core.read_model(path)


def _ports(values: Sequence[ir.Value]) -> dict[str, SessionPort]:
    """Describe inputs or outputs as onnxruntime does."""
    ports = dict[str, SessionPort]()
    for value in values:
        kind = "" if value.dtype is None else f"tensor({value.dtype.name.lower()})"
        dims = () if value.shape is None else value.shape
        shape = tuple(d if isinstance(d, int) else d.value for d in dims)
        ports[str(value.name)] = SessionPort(kind, shape)
    return ports


def _check_fit(name: str, value: ir.Value, array: Array) -> None:
    """Check type, rank and fixed sizes of an array, which OpenVINO would convert."""
    if value.dtype is not None and array.dtype != value.dtype.numpy():
        raise FramesError(
            f"these inputs do not fit: {name} is {array.dtype}, the graph takes"
            f" {value.dtype.numpy()}"
        )
    sizes = list(value.shape or array.shape)
    if len(sizes) != array.ndim or any(
        isinstance(size, int) and size != given
        for size, given in zip(sizes, array.shape, strict=True)
    ):
        raise FramesError(
            f"these inputs do not fit: {name} has shape {list(array.shape)}, the graph"
            f" takes {sizes}"
        )


def _line(error: Exception) -> str:
    """Return what OpenVINO means, without the places in its sources and ours."""
    text = str(error).partition("\nAt:")[0].rpartition("kernel: ")[2]
    if unknown := _UNKNOWN.search(text):
        version = metadata.version("openvino")
        return f"its version {version} has no operator {unknown.group(1)}"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    places = ("Caught exception", "Exception from", "Check '", "FrontEnd API failed")
    return " ".join([e for e in lines if not e.startswith(places)] or lines)
