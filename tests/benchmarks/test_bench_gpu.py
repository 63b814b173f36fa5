"""Files on the providers that are there; what is missing is said, what is done kept."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx_ir as ir
import onnxruntime as ort
import pytest

from benchmarks import bench_gpu, run_on_provider
from benchmarks.bench_gpu import ROWS, Bench, provider_or_reason
from benchmarks.gpu_table import Found, table
from benchmarks.runtime_files import REFERENCE
from benchmarks.subject import Subject
from me2e_compress.runtime.energy.energy_result import Absent
from me2e_compress.runtime.providers import (
    CPU,
    CpuProvider,
    Provider,
    TensorRtProvider,
)
from tests.frames import record

TEXT = """
<ir_version: 9, opset_import: ["" : 17]>
m (float[1,4] x, float[1,4] prev_x) => (float[1,4] plan, float[1,4] next_x) {
    plan = Add(x, prev_x)
    next_x = Identity(plan)
}
"""


@pytest.fixture
def given() -> argparse.Namespace:
    return argparse.Namespace(
        runs=6,
        seconds=60,
        warm_up=1,
        threads=1,
        energy=False,
        plugins=[],
        dialect="tensorrt",
    )


@pytest.fixture
def subject(tmp_path: Path) -> Subject:
    """A small graph in the place of the driver."""
    found = Subject("highway", tmp_path / "highway")
    found.folder.mkdir()
    ir.save(ir.from_onnx_text(TEXT), found.source)
    record(found.held_out, [{"x": np.ones((1, 4), np.float32)}])
    return found


def test_a_row_is_measured_once(
    subject: Subject, given: argparse.Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = Bench(subject, 1, given).found(CPU, REFERENCE, ROWS[REFERENCE])
    monkeypatch.setattr(subprocess, "run", None)

    assert Bench(subject, 1, given).found(CPU, REFERENCE, ROWS[REFERENCE]) == first
    assert len(first.measured["wall_s"]) == 6
    assert first.measured["sqnr_db"] == {"plan": None, "next_x": None}
    assert first.measured["gpu_reason"] == "runs on the CPU"
    *_, line, _, _, joules = table([first]).splitlines()
    assert joules == "J/frame, cpu: not asked."
    cells = line.split("|")
    assert [each.strip() for each in cells[-4:-1]] == ["∞", "∞", "-"]


def test_a_provider_that_is_missing_is_a_row_that_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CpuProvider.native])

    reason = provider_or_reason("tensorrt")

    assert isinstance(reason, str)
    shown = table([Found("highway", "tensorrt", "every file", reason)])
    assert "pip install onnxruntime-gpu, and TensorRT 10" in shown


def test_a_row_of_plugins_needs_their_library(
    subject: Subject, given: argparse.Namespace
) -> None:
    name = "fused, as plugins"

    found = Bench(subject, 1, given).found(TensorRtProvider(), name, ROWS[name])

    assert found.reason.startswith("needs --plugins LIB")


def test_a_file_that_cannot_be_made_is_a_row(
    subject: Subject, given: argparse.Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_gpu, "made", lambda *words: "a pass refused it")

    found = Bench(subject, 1, given).found(CPU, "exact", ROWS["exact"])

    assert found.reason == "not made: a pass refused it"


@pytest.mark.parametrize(
    ("provider", "reason"),
    [
        (CPU, "rapl: examples/energy_counters is not installed"),
        (
            TensorRtProvider(device=1),
            "nvml:1 is silent; ina3221: examples/energy_counters is not installed",
        ),
    ],
)
def test_energy_is_that_of_the_device_which_runs(
    provider: Provider, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        run_on_provider, "open_counter", lambda name: Absent(f"{name} is silent")
    )

    found = run_on_provider.energy(lambda: None, provider)

    assert found.reason == reason


@pytest.mark.slow
def test_the_driver_on_the_cpu(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "benchmarks.bench_gpu", str(tmp_path)]
    words += ["--providers", "cpu", "--subjects", "highway", "--frames", "2"]
    words += ["--runs", "5", "--warm-up", "1", "--no-energy"]

    subprocess.run(words, check=True, capture_output=True)

    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [each["name"] for each in rows] == [
        name for name, row in ROWS.items() if not row.on
    ]
    assert not any(each["reason"] for each in rows)
    assert "## highway" in (tmp_path / "table.md").read_text()
