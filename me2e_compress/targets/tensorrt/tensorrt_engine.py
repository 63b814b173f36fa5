"""Build an engine of a graph with TensorRT itself, where it is installed."""

import dataclasses
import importlib
import importlib.util
import time
from pathlib import Path
from typing import Any, Literal

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import MissingPackageError, PreconditionError
from me2e_compress.targets.quantized import PAIR

Precision = Literal["graph", "fp16"]


@dataclasses.dataclass(frozen=True)
class EngineSettings:
    """Options of an engine build.

    Attributes:
        precision: ``graph``: in the types of the graph, int8 pairs as int8; ``fp16``:
            float32 may also run in float16. TensorRT 11 supports only ``graph``.
        plugins: libraries of TensorRT plugins that the graph needs.
    """

    precision: Precision = "graph"
    plugins: tuple[Path, ...] = ()


@dataclasses.dataclass(frozen=True)
class TensorRTEngine:
    """A built engine; its ``content`` fits only this GPU and this TensorRT version."""

    content: bytes
    version: str
    layers: int
    seconds: float


def build_engine(path: Path, settings: EngineSettings) -> TensorRTEngine:
    """Parse a file and build an engine of it for the GPU of this machine.

    Raises:
        MissingPackageError: TensorRT is not installed.
        PreconditionError: it lacks the precision, or refuses the graph; the message
            names the node.
    """
    if importlib.util.find_spec("tensorrt") is None:
        raise MissingPackageError("tensorrt")
    try:
        trt: Any = importlib.import_module("tensorrt")  # it has no types
    except ImportError as error:  # its libraries are a package of their own
        raise PreconditionError(f"tensorrt cannot be imported: {error}") from error
    # Register TensorRT's own plugins, then those of the user.
    begun, log = time.perf_counter(), _log(trt)
    trt.init_libnvinfer_plugins(log, "")
    for library in settings.plugins:
        if not library.is_file():
            raise PreconditionError(f"plugins library {library}: no such file")
        if trt.get_plugin_registry().load_library(str(library)) is None:
            raise PreconditionError(f"plugins library {library}: TensorRT refuses it")
    builder = trt.Builder(log)
    network = builder.create_network(0)
    parser = trt.OnnxParser(network, log)
    if not parser.parse_from_file(str(path)):
        reason = "it and does not say why"
        if parser.num_errors:
            first, more = parser.get_error(0), parser.num_errors - 1
            text = " ".join(str(first.desc()).split())
            reason = f"{first.node_operator()} {first.node_name()!r}: {text}"
            reason += f", and {more} more" if more else ""
        raise PreconditionError(f"{path}: TensorRT {trt.__version__} refuses {reason}")
    # Set the types, and build.
    config = builder.create_builder_config()
    _set_types(trt, config, graph.load(path), settings.precision)
    built = builder.build_serialized_network(network, config)
    if built is None:
        reason = log.lines[-1] if log.lines else "it does not say why"
        raise PreconditionError(f"{path}: TensorRT {trt.__version__}: {reason}")
    seconds = time.perf_counter() - begun
    return TensorRTEngine(bytes(built), trt.__version__, network.num_layers, seconds)


def _log(trt: Any) -> Any:
    """Return a logger that stores errors without printing them."""

    class Messages(trt.ILogger):  # type: ignore[misc]
        def __init__(self) -> None:
            trt.ILogger.__init__(self)
            self.lines: list[str] = []

        def log(self, severity: Any, message: str) -> None:
            if severity <= trt.ILogger.Severity.ERROR:
                self.lines.append(" ".join(message.split()))

    return Messages()


def _set_types(trt: Any, config: Any, model: ir.Model, precision: Precision) -> None:
    """Allow the types that TensorRT 10 may choose; 11 uses those of the graph."""
    flags = trt.BuilderFlag
    # TensorRT 11 has no such flags.
    if not hasattr(flags, "FP16"):
        if precision == "fp16":
            raise PreconditionError(
                f"TensorRT {trt.__version__} takes the types of the graph: run"
                " convert-float16 on it instead of --precision fp16"
            )
        return
    # TensorRT 10 needs flags for the types in the graph.
    if any(node.op_type in PAIR for node in graph.nodes_of(model)):
        config.set_flag(flags.INT8)
    weights = model.graph.initializers.values()
    halves = any(value.dtype == ir.DataType.FLOAT16 for value in weights)
    if precision == "fp16" or halves:
        config.set_flag(flags.FP16)
