"""The energy of files is measured by what runs them, with any package's counter."""

from pathlib import Path

import numpy as np
import onnx
import pynvml
import pytest

from me2e_compress.errors import EnergyError
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.energy.energy_counter import EnergySchedule
from me2e_compress.runtime.energy.meter import measure_energy
from me2e_compress.runtime.frames import Array, Frame
from tests.installed import install
from tests.runtime.energy.clockwork import Clock
from tests.runtime.energy.opened import Driver

MODEL = """<ir_version: 8, opset_import: ["" : 17]>
counter (float[2] x, float[2] total) => (float[2] total_out)
{ total_out = Add (x, total) }"""
ONES: dict[str, Array] = {"x": np.ones(2, np.float32)}
FRAMES = [Frame(0, True, ONES), Frame(1, False, ONES)]
SHORT = EnergySchedule(
    *(0.02, 0.02, 5, 5), idle_s=0.02, lead_in_s=0.005
)  # whatever the machine: a clock never fails


@pytest.fixture
def model(tmp_path: Path) -> Path:
    onnx.save(onnx.parser.parse_model(MODEL), tmp_path / "m.onnx")
    return tmp_path / "m.onnx"


@pytest.fixture
def clockwork(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    target = "tests.runtime.energy.clockwork:Clockwork"
    group = "me2e_compress.energy_counters"
    install(monkeypatch, tmp_path, "clockwork", group, {"clockwork": target})


@pytest.mark.usefixtures("clockwork")
def test_any_packages_counter_measures_models_in_turn(model: Path) -> None:
    seen, closed = list[tuple[int, int, str]](), Clock.closed

    found = measure_energy(
        {"a": model, "b": model},
        FRAMES,
        "clockwork:20",
        SHORT,
        on_window=lambda *told: seen.append(told),
    )

    assert [name for _, _, name in seen] == [*"abbaabbaab", "b"]
    assert [result.windows for result in found.values()] == [5, 5]
    assert found["a"].j_per_frame is not None
    assert found["a"].model_sha256 == sha256_of(model)
    assert Clock.closed == closed + 1


def test_without_a_counter_nothing_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "m.onnx").write_bytes(b"no model")
    Driver(monkeypatch, init=-pynvml.NVML_ERROR_LIBRARY_NOT_FOUND)

    found = measure_energy({"m": tmp_path / "m.onnx"}, FRAMES, "nvml")["m"]

    assert found.j_per_frame is None
    assert "nvml: NVML Shared Library Not Found" in found.reason


def test_a_recording_is_of_one_model(model: Path, tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("time_s,frames,watts\n0,0,1\n1,1,1")

    with pytest.raises(EnergyError, match="a recording is of one model, and there are"):
        measure_energy(
            {"a": model, "b": model}, FRAMES, f"recorded:{tmp_path / 'r.csv'}"
        )


@pytest.mark.usefixtures("clockwork")
def test_no_frame_is_an_error(model: Path) -> None:
    with pytest.raises(EnergyError, match="there is no frame to run"):
        measure_energy({"m": model}, [], "clockwork", SHORT)
