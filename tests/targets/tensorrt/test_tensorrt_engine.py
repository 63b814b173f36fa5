"""Engines by TensorRT, which a stand-in plays: versions 10 and 11 as their bindings."""

import enum
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import onnx_ir as ir
import pytest

from me2e_compress.errors import MissingPackageError, PreconditionError
from me2e_compress.targets.tensorrt.tensorrt_engine import EngineSettings, build_engine

HEAD = '<ir_version: 9, opset_import: ["" : 17]> m (float[2] x) => (float[2] y)'
FLOAT = f"{HEAD} {{ y = Neg(x) }}"
INT8 = (
    f"{HEAD} <float s = {{0.5}}, int8 z = {{0}}>"
    " { q = QuantizeLinear(x, s, z) y = DequantizeLinear(q, s, z) }"
)


class _Log:
    Severity = enum.IntEnum("Severity", {"ERROR": 1, "WARNING": 2})


class _Parser:
    """Refuses what its text says; counts what it is given."""

    num_errors = 2

    def __init__(self, network: Any, log: Any) -> None:
        self.network = network

    def parse_from_file(self, path: str) -> bool:
        return ir.load(path).graph.name != "refused"

    def get_error(self, index: int) -> Any:
        return SimpleNamespace(
            node_operator=lambda: "Twist",
            node_name=lambda: "/head/twist",
            desc=lambda: "no plugin\nof that name",
        )


class _Builder:
    def __init__(self, log: Any) -> None:
        self.config = SimpleNamespace(flags=[])
        self.config.set_flag = self.config.flags.append

    def create_network(self, flags: int) -> Any:
        return SimpleNamespace(num_layers=3)

    def create_builder_config(self) -> Any:
        return self.config

    def build_serialized_network(self, network: Any, config: Any) -> bytes:
        return f"{sorted(config.flags)}".encode()


@pytest.fixture
def tensorrt(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> int:
    """TensorRT of the version that a test names; it answers what it was told."""
    version: int = getattr(request, "param", 10)
    module = ModuleType("tensorrt")
    module.__spec__ = ModuleSpec("tensorrt", None)
    flags = {"FP16": "FP16", "INT8": "INT8"} if version == 10 else {}
    vars(module).update(
        __version__=f"{version}.4.0",
        ILogger=_Log,
        Builder=_Builder,
        OnnxParser=_Parser,
        BuilderFlag=SimpleNamespace(**flags),
        init_libnvinfer_plugins=lambda log, namespace: True,
        get_plugin_registry=lambda: SimpleNamespace(load_library=lambda path: None),
    )
    monkeypatch.setitem(sys.modules, "tensorrt", module)
    return version


def written(tmp_path: Path, text: str = FLOAT) -> Path:
    ir.save(ir.from_onnx_text(text), tmp_path / "m.onnx")
    return tmp_path / "m.onnx"


@pytest.mark.usefixtures("tensorrt")
@pytest.mark.parametrize(
    ("text", "precision", "flags"),
    [
        (FLOAT, "graph", []),
        (FLOAT, "fp16", ["FP16"]),
        (INT8, "graph", ["INT8"]),
        (INT8, "fp16", ["FP16", "INT8"]),
    ],
)
def test_tensorrt_10_is_allowed_the_types_of_the_graph(
    tmp_path: Path, text: str, precision: Any, flags: list[str]
) -> None:
    found = build_engine(written(tmp_path, text), EngineSettings(precision))

    assert found.content.decode() == f"{flags}"
    assert (found.version, found.layers) == ("10.4.0", 3)


@pytest.mark.parametrize("tensorrt", [11], indirect=True)
def test_tensorrt_11_takes_the_types_of_the_graph(
    tensorrt: int, tmp_path: Path
) -> None:
    found = build_engine(written(tmp_path, INT8), EngineSettings())
    assert found.content.decode() == "[]"  # int8 without a flag
    with pytest.raises(
        PreconditionError, match=r"11\.4\.0 takes the types of the graph"
    ):
        build_engine(written(tmp_path), EngineSettings("fp16"))


@pytest.mark.usefixtures("tensorrt")
def test_a_node_that_is_refused_is_named(tmp_path: Path) -> None:
    path = written(tmp_path, FLOAT.replace("> m (", "> refused ("))

    with pytest.raises(PreconditionError) as refusal:
        build_engine(path, EngineSettings())

    assert str(refusal.value) == (
        f"{path}: TensorRT 10.4.0 refuses Twist '/head/twist': no plugin of that name,"
        " and 1 more"
    )


@pytest.mark.usefixtures("tensorrt")
def test_a_library_without_plugins_is_refused(tmp_path: Path) -> None:
    library = tmp_path / "plugins.so"
    library.touch()

    with pytest.raises(PreconditionError, match=r"plugins\.so: TensorRT refuses it"):
        build_engine(written(tmp_path), EngineSettings(plugins=(library,)))


def test_without_tensorrt_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    with pytest.raises(MissingPackageError, match="pip install tensorrt"):
        build_engine(written(tmp_path), EngineSettings())
