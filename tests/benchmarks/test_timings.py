"""What is timed answers right; what is missing is said, and what is done is kept."""

import argparse
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.measure.energy import COUNTER, FRAMES_MS, conditions, held
from benchmarks.measure.gpu import ROWS, Bench
from benchmarks.subjects.original_patterns import FORMS, restored
from benchmarks.subjects.runtime_files import REFERENCE
from benchmarks.subjects.subject import Subject
from benchmarks.tools.gpu_table import table as gpu_table
from me2e_compress.runtime.energy.energy_counter import EnergySchedule
from me2e_compress.runtime.providers import CPU
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
