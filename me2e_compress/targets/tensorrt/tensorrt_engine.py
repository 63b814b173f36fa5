"""Build an engine of a graph with TensorRT itself, where it is installed."""

import dataclasses
import importlib
import importlib.util
import time
from collections.abc import Sequence
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
    # Parse the graph with the user's plugins.
    trt, begun = _tensorrt(), time.perf_counter()
    log = _log(trt)
    _load_plugins(trt, log, settings.plugins)
    builder = trt.Builder(log)
    network = builder.create_network(0)
    parser = trt.OnnxParser(network, log)
    if not parser.parse_from_file(str(path)):
        raise PreconditionError(f"{path}: {_refusal(trt, parser)}")
    # Set the types, and build.
    config = builder.create_builder_config()
    _set_types(trt, config, graph.load(path), settings.precision)
    built = builder.build_serialized_network(network, config)
    if built is None:
        reason = log.lines[-1] if log.lines else "it does not say why"
        raise PreconditionError(f"{path}: TensorRT {trt.__version__}: {reason}")
    seconds = time.perf_counter() - begun
    return TensorRTEngine(bytes(built), trt.__version__, network.num_layers, seconds)


def _tensorrt() -> Any:
    """Import TensorRT, which has no types."""
    if importlib.util.find_spec("tensorrt") is None:
        raise MissingPackageError("tensorrt")
    try:
        return importlib.import_module("tensorrt")
    except ImportError as error:  # its libraries are a package of their own
        raise PreconditionError(f"tensorrt cannot be imported: {error}") from error


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


def _load_plugins(trt: Any, log: Any, libraries: Sequence[Path]) -> None:
    """Register TensorRT's own plugins, then those of the user."""
    trt.init_libnvinfer_plugins(log, "")
    for library in libraries:
        if not library.is_file():
            raise PreconditionError(f"plugins library {library}: no such file")
        if trt.get_plugin_registry().load_library(str(library)) is None:
            raise PreconditionError(f"plugins library {library}: TensorRT refuses it")


def _refusal(trt: Any, parser: Any) -> str:
    count = parser.num_errors
    if not count:
        return f"TensorRT {trt.__version__} refuses it and does not say why"
    first = parser.get_error(0)
    more = f", and {count - 1} more" if count > 1 else ""
    where = f"{first.node_operator()} {first.node_name()!r}"
    text = " ".join(str(first.desc()).split())
    return f"TensorRT {trt.__version__} refuses {where}: {text}{more}"


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
