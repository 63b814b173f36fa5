"""Execution providers of onnxruntime, and users' operator libraries."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

import onnx_ir as ir
import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as _native  # pyright: ignore[reportAttributeAccessIssue]
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema

from me2e_compress.base.errors import ProviderError
from me2e_compress.base.registry import Registry
from me2e_compress.graph.files import file_contains
from me2e_compress.graph.recurrence import SessionPort
from me2e_compress.runtime.frames import Array

# Providers in onnxruntime's form; each runs what those before it cannot
Chain: TypeAlias = list[str | tuple[str, dict[str, str]]]

# Optimizations of onnxruntime up to 1.31 that change the result: this one folds a Pad
# of zeros into the MaxPool after it, whose own padding is minus infinity.
WRONG_FUSIONS = ("Pad_Fusion",)
# Optimizations that slow down the CPU: the fused kernel of Add and LayerNormalization
# takes 4.0 to 6.9 times as long as the two (64 to 768 columns, 100 to 10,000 rows, one
# thread and two), 2.7 times on 20 rows, and as long on one
# (`benchmarks/measure/levers.py`).
SLOW_FUSIONS = ("SkipLayerNormFusion",)

_CPU = "CPUExecutionProvider"
_CUDA = "CUDAExecutionProvider"
_GPU_PACKAGE = "pip uninstall onnxruntime; pip install onnxruntime-gpu"
_LIBRARY_ERRORS = (_native.Fail, _native.RuntimeException, RuntimeError)
_ENTRY_POINT = b"RegisterCustomOps"  # of every library of onnxruntime operators


class Engine(abc.ABC):
    """An open graph: its ports and metadata, and what runs it."""

    inputs: Mapping[str, SessionPort]
    outputs: Mapping[str, SessionPort]
    metadata: Mapping[str, str]

    @abc.abstractmethod
    def run(self, names: Sequence[str], inputs: Mapping[str, Array]) -> list[Array]:
        """Run one inference, of all inputs, and return the named outputs.

        An input that does not fit is a FramesError, a node that fails a GraphError.
        """

    def end_profile(self) -> Path:
        """Write the profile of its nodes; return the file."""
        raise ProviderError("times of nodes are measured in onnxruntime alone")


@dataclasses.dataclass(frozen=True)
class Provider(abc.ABC):
    """An execution provider; the fields are its options.

    Class attributes:
        name: its name on the command line.
        native: its name in onnxruntime.
        advice: what to do where it is not installed.
        engine: what runs it, as traces name it.
        left_out: optimizations that are disabled for it.
        target: the target whose int8 format it runs.

    Attributes:
        plugins: libraries of onnxruntime operators that the graph needs.
    """

    name: ClassVar[str]
    native: ClassVar[str]
    advice: ClassVar[str]
    engine: ClassVar[str] = "onnxruntime"
    left_out: ClassVar[tuple[str, ...]] = WRONG_FUSIONS
    target: ClassVar[str] = "onnxruntime"
    plugins: tuple[Path, ...] = dataclasses.field(default=(), kw_only=True)

    def check(self) -> None:
        """Check that it is installed and its libraries exist; else a ProviderError."""
        for library in self.plugins:
            if not library.is_file():
                raise ProviderError(f"plugins library {library}: no such file")
        available = ort.get_available_providers()
        if not self.is_installed():
            raise ProviderError(
                f"provider {self.name}: onnxruntime {ort.__version__} has only"
                f" {', '.join(available)}; {self.advice}"
            )

    def claims(self, op_type: str) -> bool:
        """Return whether a user's library holds an operator's name, and so runs it."""
        return any(file_contains(library, op_type.encode()) for library in self.plugins)

    def is_installed(self) -> bool:
        """Return whether this onnxruntime has it; its device may still be missing."""
        return self.native in ort.get_available_providers()

    def attach(self, options: ort.SessionOptions) -> None:
        """Register the users' operators in the options of a session.

        A provider that is not installed, or a library without operators, is a
        ProviderError.
        """
        self.check()
        for library in self.plugins:
            try:
                options.register_custom_ops_library(str(library))
            except _LIBRARY_ERRORS as error:
                line = " ".join(str(error).split())
                raise ProviderError(f"plugins library {library}: {line}") from error

    def open(
        self, model: ir.Model | Path, threads: int, *, int8_kernels: bool
    ) -> Engine | None:
        """Open a graph in an engine of its own; None where onnxruntime runs it."""
        return None

    def chain(self) -> Chain | None:
        """Return the providers of a session; None where it needs none."""
        return None

    def confirm(self, running: Sequence[str]) -> None:
        """Check that it is among the ``running`` providers; else a ProviderError."""
        # onnxruntime silently falls back to the CPU
        if self.native not in running:
            raise ProviderError(
                f"provider {self.name} cannot start here: its driver or libraries are"
                f" missing; onnxruntime would run on {', '.join(running)}"
            )

    def __str__(self) -> str:
        """Return the text that `PROVIDERS` reads."""
        return PROVIDERS.text(self)

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Let an option that is any provider take its text."""
        if cls is not Provider:
            return handler(source)
        return PROVIDERS.option_schema(Provider)


@dataclasses.dataclass(frozen=True)
class CpuProvider(Provider):
    """onnxruntime's own kernels on the CPU."""

    name: ClassVar[str] = "cpu"
    native: ClassVar[str] = _CPU
    advice: ClassVar[str] = "pip install onnxruntime"
    left_out: ClassVar[tuple[str, ...]] = (*WRONG_FUSIONS, *SLOW_FUSIONS)

    def chain(self) -> Chain:
        """Return the CPU provider."""
        return [_CPU]


@dataclasses.dataclass(frozen=True)
class CudaProvider(Provider):
    """onnxruntime's CUDA kernels; int8 runs in float there.

    Attributes:
        device: index of the GPU.
        tf32: round the operands of products to 10 bits of mantissa: faster.
    """

    name: ClassVar[str] = "cuda"
    native: ClassVar[str] = _CUDA
    advice: ClassVar[str] = _GPU_PACKAGE
    device: int = 0
    tf32: bool = False

    def attach(self, options: ort.SessionOptions) -> None:
        """Attach as the base does, and load CUDA and cuDNN from installed packages."""
        super().attach(options)
        ort.preload_dlls()

    def chain(self) -> Chain:
        """Return CUDA, then the CPU."""
        options = {"device_id": str(self.device), "use_tf32": str(int(self.tf32))}
        return [(_CUDA, options), _CPU]


@dataclasses.dataclass(frozen=True)
class TensorRtProvider(Provider):
    """TensorRT 10, through onnxruntime: an engine is built when a session opens.

    Attributes:
        device: index of the GPU.
        precision: ``fp32``, ``fp16``, ``int8`` (of QDQ pairs), or ``best`` for both.
        cache: folder of engines and timings; without it they are built every time.
        plugins: libraries that the graph needs, of onnxruntime operators or of
            TensorRT plugins.
    """

    name: ClassVar[str] = "tensorrt"
    native: ClassVar[str] = "TensorrtExecutionProvider"
    advice: ClassVar[str] = f"{_GPU_PACKAGE}, and TensorRT 10"
    target: ClassVar[str] = "tensorrt"
    device: int = 0
    precision: Literal["fp32", "fp16", "int8", "best"] = "fp32"
    cache: Path | None = None

    def attach(self, options: ort.SessionOptions) -> None:
        """Register the libraries of onnxruntime operators, and load CUDA."""
        ours = tuple(path for path in self.plugins if not self._is_plugin(path))
        self.check()
        CudaProvider(self.device, plugins=ours).attach(options)

    def chain(self) -> Chain:
        """Return TensorRT, then CUDA, then the CPU."""
        options = {
            "device_id": str(self.device),
            "trt_fp16_enable": str(self.precision in ("fp16", "best")),
            "trt_int8_enable": str(self.precision in ("int8", "best")),
        }
        if self.cache is not None:
            for kind in ("engine", "timing"):
                options[f"trt_{kind}_cache_enable"] = "True"
                options[f"trt_{kind}_cache_path"] = str(self.cache)
        theirs = [str(library) for library in self.plugins if self._is_plugin(library)]
        if theirs:
            options["trt_extra_plugin_lib_paths"] = ";".join(theirs)
        return [(self.native, options), *CudaProvider(self.device).chain()]

    @staticmethod
    def _is_plugin(library: Path) -> bool:
        """Return whether a library lacks onnxruntime operators, without running it."""
        return library.is_file() and not file_contains(library, _ENTRY_POINT)


CPU = CpuProvider()

_HERE = "me2e_compress.runtime.providers"
PROVIDERS: Registry[Provider] = Registry(
    "provider",
    "me2e_compress.providers",
    ProviderError,
    {
        "cpu": f"{_HERE}:CpuProvider",
        "cuda": f"{_HERE}:CudaProvider",
        "openvino": "me2e_compress.runtime.openvino:OpenVinoProvider",
        "tensorrt": f"{_HERE}:TensorRtProvider",
    },
)


def provider_named(text: str, plugins: Sequence[Path] = ()) -> Provider:
    """Build the provider of a text, and check that it is installed.

    ``text`` is e.g. ``cpu``, ``cuda``, ``tensorrt{precision=fp16, cache=engines}``. An
    unknown provider, option or library is a ProviderError.
    """
    provider = PROVIDERS.parse(text)
    provider = dataclasses.replace(provider, plugins=(*provider.plugins, *plugins))
    provider.check()
    return provider
