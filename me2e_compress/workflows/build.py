"""Build a TensorRT engine of a graph, where TensorRT is installed."""

import dataclasses
from pathlib import Path

from me2e_compress.errors import GraphError
from me2e_compress.registry import drafts
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.targets.tensorrt.tensorrt_engine import (
    EngineSettings,
    TensorRTEngine,
    build_engine,
)
from me2e_compress.workflows.checks import model_path, output_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, counted, megabytes


@dataclasses.dataclass(frozen=True)
class BuildOptions:
    """How an engine is built.

    Attributes:
        settings: settings of the TensorRT builder.
        force: replace outputs that we did not write, too.
    """

    settings: EngineSettings = dataclasses.field(default_factory=EngineSettings)
    force: bool = False


@dataclasses.dataclass(frozen=True, repr=False)
class EngineResult(Result):
    """A TensorRT engine that was written."""

    model: Path
    output: Path
    engine: TensorRTEngine

    @property
    def headline(self) -> str:
        """The engine file, its size, TensorRT's version and the build time."""
        found = self.engine
        return (
            f"{self.output}: {megabytes(len(found.content))} MB, TensorRT"
            f" {found.version}, {counted(found.layers, 'layer')} parsed,"
            f" {found.seconds:.0f} s; it fits this GPU and this version"
        )

    def to_json(self) -> dict[str, object]:
        """Return everything about the engine except its bytes."""
        return {
            "engine_bytes": len(self.engine.content),
            "tensorrt": self.engine.version,
            "layers": self.engine.layers,
            "seconds": self.engine.seconds,
        }


def build(
    model: str | Path,
    output: str | Path,
    options: BuildOptions | None = None,
    listener: Listener = SILENT,
) -> EngineResult:
    """Build a TensorRT engine of a graph for the GPU of this machine.

    The model is an ONNX file or the name of one that ships.

    Raises:
        GraphError: The model does not exist, or the output would harm an input.
        MissingPackageError: TensorRT is not installed.
        PreconditionError: TensorRT lacks an option, or refuses the graph.
    """
    options = options or BuildOptions()
    source, output = model_path(model), output_path(output)
    # the engine is written only when it is whole
    with writing([output], (source,), force=options.force):
        listener.on_progress("build", 0, 1, source.name)
        engine = build_engine(source, options.settings)
        with drafts.written(output, GraphError):
            write_bytes(output, engine.content)
        listener.on_progress("build", 1, 1, source.name)
    return EngineResult(source, output, engine)
