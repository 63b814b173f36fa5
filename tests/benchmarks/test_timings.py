"""What is timed answers right; what is missing is said, and what is done is kept."""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
import torch

from benchmarks.measure.energy import COUNTER, FRAMES_MS, conditions, held
from benchmarks.measure.gpu import ROWS, Bench, provider_or_reason
from benchmarks.measure.int8_shapes import FORMS as INT8_FORMS
from benchmarks.measure.int8_shapes import Convolution, product, session
from benchmarks.subjects.original_patterns import FORMS, restored
from benchmarks.subjects.runtime_files import REFERENCE
from benchmarks.subjects.subject import Subject
from benchmarks.tools.gpu_table import Found
from benchmarks.tools.gpu_table import table as gpu_table
from me2e_compress.runtime.energy.energy_counter import EnergySchedule
from me2e_compress.runtime.providers import CPU, CpuProvider
from models.tests.vad.sizes import SIZES
from models.vad.stack import VadTiny
from tests.support.frames import record
from tests.support.nets import save_text


@pytest.fixture
def given() -> argparse.Namespace:
    words: dict[str, Any] = {"plugins": [], "dialect": "tensorrt", "energy": False}
    return argparse.Namespace(runs=6, seconds=60, warm_up=1, threads=1, **words)


@pytest.fixture
def subject(tmp_path: Path) -> Subject:
    """A small graph in the place of the driver."""
    found = Subject("highway", tmp_path / "highway")
    found.folder.mkdir()
    save_text(
        found.source,
        "m (float[1,4] x, float[1,4] prev_x) => (float[1,4] plan, float[1,4] next_x)"
        " { plan = Add(x, prev_x) next_x = Identity(plan) }",
    )
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
    *_, line, _, _, joules = gpu_table([first]).splitlines()
    assert joules == "J/frame, cpu: not asked."
    cells = line.split("|")
    assert [each.strip() for each in cells[-4:-1]] == ["∞", "∞", "-"]


def test_a_provider_that_is_missing_is_a_row_that_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CpuProvider.native])

    reason = provider_or_reason("tensorrt")

    assert isinstance(reason, str)
    shown = gpu_table([Found("highway", "tensorrt", "every file", reason)])
    assert "pip install onnxruntime-gpu, and TensorRT 10" in shown


@pytest.mark.slow
def test_the_driver_on_the_cpu(tmp_path: Path) -> None:
    words = "--providers cpu --subjects highway --frames 2 --runs 5 --warm-up 1"
    command = [sys.executable, "-m", "benchmarks.measure.gpu", str(tmp_path)]

    subprocess.run(
        [*command, "--no-energy", *words.split()], check=True, capture_output=True
    )

    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    names = [name for name, row in ROWS.items() if not row.on]
    assert [(each["name"], each["reason"]) for each in rows] == [(n, "") for n in names]
    assert "## highway" in (tmp_path / "table.md").read_text()


def test_intervals_of_energy_hold_the_truth() -> None:
    """Of two thousand measurements on simulated counters, but for frames of 5 ms."""
    frames = [frame_ms for frame_ms in FRAMES_MS if frame_ms > 5]
    found = [
        held(load, COUNTER, EnergySchedule(windows=8), simulations=84, seed=seed)
        for seed, (_, _, load) in enumerate(conditions(frames))
    ]

    assert sum(each.simulations for each in found) >= 2_000
    assert 0.93 <= np.mean([each.taken for each in found]) <= 0.98
    assert 0.93 <= np.mean([each.mean for each in found]) <= 0.98
    assert min(each.taken for each in found) >= 0.87  # 84 of 95 %: 3 deviations
    assert np.median([each.width for each in found]) <= 0.1


def test_layers_run_in_every_form_with_their_own_macs() -> None:
    layer = Convolution("strided", 2, 6, 4, 8, 16, kernel=3, stride=2)
    pixels = np.ones((2, 6, 4, 8), np.uint8)

    found: Any = session(layer.text(), (16, 8, 3, 3), 0).run(None, {"x": pixels})[0]

    assert found.shape == (2, 3, 2, 16)
    assert layer.macs == found.size * 8 * 9
    for form in INT8_FORMS:
        rows = np.ones((5, 8), np.uint8)
        answer: Any = product(form, 5, (8, 16)).run(None, {"x": rows})[0]
        assert answer.shape == (5, 16)


def test_the_forms_of_the_original_compute_what_those_of_models_do() -> None:
    size = SIZES["small"]
    draws = torch.Generator().manual_seed(0)
    model = VadTiny("nuscenes", "operator", size.config).requires_grad_(False).eval()
    for weight in model.parameters():
        weight.normal_(0.0, 0.1, generator=draws)
    img, lidar2img, can_bus, bev = (
        torch.randn(shape, generator=draws) for shape in size.stack.inputs.values()
    )
    lidar2img = torch.eye(4) + lidar2img / 10  # some pillars are seen
    inputs = img, lidar2img, can_bus, bev
    with torch.no_grad():
        wanted = model(*inputs)
        found = restored(model)(*inputs)
    assert set(map(type, model.modules())) >= set(FORMS.values())
    for name, one, two in zip(size.stack.outputs, wanted, found, strict=True):
        assert (one - two).abs().max() < 1e-4 * one.abs().max(), name
