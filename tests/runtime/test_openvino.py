"""Graphs in OpenVINO: the same answers, kernels inside, and refusals in a line."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from me2e_compress.base.errors import (
    FramesError,
    GraphError,
    MissingExtraError,
    ProviderError,
)
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.runtime import openvino
from me2e_compress.runtime.openvino import OpenVinoProvider
from me2e_compress.runtime.profile import machine_text
from me2e_compress.runtime.providers import CPU, provider_named
from me2e_compress.runtime.session import Session
from tests.operators.kernels import needs_kernels
from tests.operators.kernels.test_session import call
from tests.support.frames import record
from tests.support.nets import conv_attention, image, parsed

OPENVINO = OpenVinoProvider()
SUM = """m (float[2] x, float[2] prev_s) => (float[2] s, float[2] next_s)
    { next_s = Add(x, prev_s) s = Identity(next_s) }"""


def test_it_answers_as_onnxruntime_does(tmp_path: Path) -> None:
    model, frame = conv_attention(), image(0)
    reference = Session(model, threads=1)
    feeds = {**frame, **reference.first_state({})}
    wanted = reference.run(feeds)

    values = Session(model, threads=2, provider=OPENVINO).run(feeds)
    for name, value in wanted.items():
        gap = values[name].astype(np.float64) - value.astype(np.float64)
        assert abs(gap).max() < 1e-3
    frames, names = CalibrationSet(record(tmp_path, [image(0)])), ("a",)
    ours, its = (Calibrator("mse", provider=by) for by in (CPU, OPENVINO))
    counts = its.collect(model, names, frames).histograms()
    apart = counts - ours.collect(model, names, frames).histograms()
    assert abs(apart).sum() < 0.01 * counts.sum()


def test_two_names_of_one_port_and_state_are_known() -> None:
    session = Session(parsed(SUM), threads=1, provider=OPENVINO)
    text = machine_text(2, OpenVinoProvider(precision="bf16"))
    assert text.endswith('OpenVINO on 2 threads, openvino{precision="bf16"}')

    values = session.run({"x": np.ones(2, "f"), "prev_s": np.full(2, 3, "f")})

    assert session.recurrent == {"prev_s": "next_s"}
    assert [values[name].tolist() for name in ("s", "next_s")] == [[4, 4]] * 2


@needs_kernels
@pytest.mark.parametrize("threads", [1, 2])
def test_kernels_run_inside(threads: int) -> None:
    model, arrays = call()
    wanted = Session(model, threads=1).run(arrays)["result"]
    session = Session(model, threads=threads, provider=OPENVINO)
    assert np.array_equal(session.run(arrays)["result"], wanted)


@needs_kernels
def test_where_a_kernel_refuses_its_inputs_the_body_runs_told_once() -> None:
    model, arrays = call()
    session = Session(model, threads=1, provider=OPENVINO)
    arrays["level_start_index"] = arrays["level_start_index"] - 1

    with pytest.warns(RuntimeWarning, match="a number is negative: bodies run"):
        first = session.run(arrays)
    assert np.array_equal(session.run(arrays)["result"], first["result"])


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        ({"x": np.ones(3, "f")}, r"do not fit: x has shape \[3\], the graph takes \[2"),
        ({"x": np.ones(2)}, "do not fit: x is float64, the graph takes float32"),
    ],
)
def test_inputs_that_do_not_fit_are_named(
    frame: dict[str, npt.NDArray[Any]], reason: str
) -> None:
    model = parsed("m (float[2] x) => (float[2] y) { y = Neg(x) }")
    session = Session(model, provider=OPENVINO)
    with pytest.raises(FramesError, match=reason):
        session.run(frame)


def test_an_operator_that_it_lacks_is_named_with_its_version() -> None:
    unknown = parsed(
        '<ir_version: 9, opset_import: ["": 17, "their.own": 1]>'
        " m (float[2] x) => (float[2] y) { y = their.own.Wavelet(x) }"
    )
    reason = r"its version 2026\.\S+ has no operator their\.own\.Wavelet$"
    with pytest.raises(GraphError, match=reason):
        Session(unknown, provider=OPENVINO)


def test_bfloat16_is_refused_where_the_cpu_has_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    old = SimpleNamespace(get_property=lambda device, name: ["FP32", "INT8"])
    monkeypatch.setattr(openvino, "new_core", lambda: old)
    with pytest.raises(ProviderError, match="this CPU has no bf16, only FP32, INT8"):
        provider_named("openvino{precision=bf16}")


def test_without_the_package_a_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("me2e_compress.base.extras.MODULES", {"openvino": ("no_ov",)})
    with pytest.raises(MissingExtraError, match=r"provider openvino .*\[openvino\]"):
        provider_named("openvino")
