"""Who runs a session: what is there, what is not, and what is said of it."""

import dataclasses
import shutil
import subprocess
from pathlib import Path
from typing import ClassVar

import numpy as np
import onnx_ir as ir
import onnxruntime as ort
import pytest

from me2e_compress.base.errors import ProviderError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.runtime.providers import (
    CPU,
    PROVIDERS,
    CpuProvider,
    CudaProvider,
    TensorRtProvider,
    provider_named,
)
from me2e_compress.runtime.session import Session
from tests.support.nets import parsed, save_text

NEGATE = "m (float[2] x) => (float[2] y) { y = Neg(x) }"


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """An onnxruntime with nothing but the CPU, whatever is installed here."""
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CPU.native])


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    ("name", "package"),
    [
        ("cuda", "pip install onnxruntime-gpu"),
        ("tensorrt", "pip install onnxruntime-gpu, and TensorRT 10"),
    ],
)
def test_a_provider_that_is_not_installed_says_what_to_install(
    name: str, package: str
) -> None:
    with pytest.raises(ProviderError) as refusal:
        provider_named(name)

    line = str(refusal.value)
    assert line.startswith(f"provider {name}: onnxruntime {ort.__version__} has only")
    assert line.endswith(package)
    assert "\n" not in line


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "npu",
            "no provider 'npu'; there are cpu, cuda, openvino, tensorrt",
        ),
        ("cpu{threads=4}", "cpu has no option 'threads'"),
        ("tensorrt{precision=fp4}", "tensorrt: precision: "),
    ],
)
def test_providers_that_are_none(text: str, reason: str) -> None:
    with pytest.raises(ProviderError, match=r"^" + reason):
        provider_named(text)


def test_a_file_that_is_not_there_or_no_library(tmp_path: Path) -> None:
    library = tmp_path / "text.so"
    with pytest.raises(ProviderError, match=r"text\.so: no such file"):
        provider_named("cpu", [library])
    library.write_text("not a library")
    with pytest.raises(ProviderError) as refusal:
        Session(parsed(NEGATE), provider=provider_named("cpu", [library]))

    assert str(refusal.value).startswith(f"plugins library {library}: ")
    assert "\n" not in str(refusal.value)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no compiler")
def test_a_users_library_is_registered(tmp_path: Path) -> None:
    library = tmp_path / "operators.so"
    called = tmp_path / "called"
    source = (
        "#include <stdio.h>\n"
        "void *RegisterCustomOps(void *options, const void *api) {"
        f' fclose(fopen("{called}", "w")); return 0; }}'
    )
    words = ["cc", "-shared", "-fPIC", "-x", "c", "-", "-o", str(library)]
    subprocess.run(words, input=source, text=True, check=True)

    session = Session(parsed(NEGATE), provider=provider_named("cpu", [library]))

    assert called.exists()
    assert session.run({"x": np.ones(2, np.float32)})["y"].tolist() == [-1.0, -1.0]


def test_options_of_tensorrt_in_onnxruntimes_words(tmp_path: Path) -> None:
    plugins = tmp_path / "plugins.so"
    plugins.write_bytes(b"\x7fELF with creators of plugins")
    chosen = PROVIDERS.parse("tensorrt{precision=best, cache=engines, device=1}")

    first, *rest = dataclasses.replace(chosen, plugins=(plugins,)).chain() or []

    assert first == (
        "TensorrtExecutionProvider",
        {
            "device_id": "1",
            "trt_fp16_enable": "True",
            "trt_int8_enable": "True",
            "trt_engine_cache_enable": "True",
            "trt_engine_cache_path": "engines",
            "trt_timing_cache_enable": "True",
            "trt_timing_cache_path": "engines",
            "trt_extra_plugin_lib_paths": str(plugins),
        },
    )
    cuda = {"device_id": "1", "use_tf32": "0"}
    assert rest == [("CUDAExecutionProvider", cuda), CPU.native]


def test_a_provider_that_onnxruntime_went_on_without() -> None:
    with pytest.raises(ProviderError, match="tensorrt cannot start here"):
        TensorRtProvider().confirm([CPU.native])


@pytest.mark.usefixtures("bare")
def test_a_driver_opens_its_model_on_its_provider(tmp_path: Path) -> None:
    path = save_text(tmp_path / "m.onnx", NEGATE)

    with pytest.raises(ProviderError, match="provider cuda: "):
        OnnxDriver(path, provider=CudaProvider(device=1)).open()


@dataclasses.dataclass(frozen=True)
class _Watched(CpuProvider):
    """The CPU without any fusion that it leaves out, or with: told by its class."""

    left_out: ClassVar[tuple[str, ...]] = ()


@pytest.mark.parametrize(
    ("provider", "kernel"),
    [(CPU, "LayerNormalization"), (_Watched(), "SkipLayerNormalization")],
)
def test_the_cpu_leaves_out_the_fusion_that_is_slow_there(
    provider: CpuProvider, kernel: str, tmp_path: Path
) -> None:
    model = parsed(
        "m (float[1,2,4] x) => (float[1,2,4] y)"
        " <float[4] s = {1.0, 1.0, 1.0, 1.0}>"
        " { a = Add(x, x) y = LayerNormalization(a, s, s) }"
    )
    path = tmp_path / "rewritten.onnx"

    Session(model, rewritten=path, provider=provider)

    assert kernel in [node.op_type for node in ir.load(path).graph]
