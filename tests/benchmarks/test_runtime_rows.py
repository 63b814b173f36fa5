"""Which rows a table of runtimes has, and how OpenVINO's ports answer to names."""

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.measure.runtime import Row, outputs_table, table
from benchmarks.subjects.runtime_files import ENTRIES, REFERENCE, TARGETS
from benchmarks.tools.run_one import ENGINES, all_outputs


class Port(SimpleNamespace):
    """Of a compiled model: the names that are one value."""

    __hash__ = object.__hash__  # type: ignore[assignment]


def test_a_port_is_fed_and_read_by_any_of_its_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = Port(names={"y", "same as y"})
    compiled = SimpleNamespace(inputs=[Port(names={"an alias", "x"})], outputs=[out])
    compiled.create_infer_request = lambda: SimpleNamespace(
        infer=lambda fed: {out: fed[0] * 2.0}
    )
    core = SimpleNamespace(
        read_model=lambda path: path, compile_model=lambda *given: compiled
    )
    fake: Any = SimpleNamespace(Core=lambda: core)
    monkeypatch.setitem(sys.modules, "openvino", fake)
    run = ENGINES["openvino-f32"]("m.onnx", 1)
    found = all_outputs(run, [{"x": np.ones(2)}, {"x": np.zeros(2)}])
    assert found.keys() == {"y", "same as y"}
    np.testing.assert_array_equal(found["y"], [[2, 2], [0, 0]])


def test_peers_and_every_placement_have_their_rows() -> None:
    files = {(entry.engine, entry.file) for entry in ENTRIES.values()}
    for precision in ("f32", "bf16"):
        engine = f"openvino-{precision}"
        for file in ("source", "nncf", "nncf-by-hand", *(f"full-{t}" for t in TARGETS)):
            assert (engine, file) in files
    for entry in ENTRIES.values():
        assert not (entry.peer and "attach-bodies" in entry.passes)
        if entry.file.startswith("full") and entry.engine == "ours":
            assert f'target="{entry.file.rpartition("-")[2]}"' in entry.passes


def test_a_row_tells_its_least_and_mean_decibels_and_every_output_s() -> None:
    rows = {
        REFERENCE: Row([2.0, 4.0], [1.0], 5.0, {"plan": 90.0, "heat": 80.0}),
        "other": Row([1.0, 3.0], [1.0], 5.0, {"plan": 20.0, "heat": 30.0}),
    }
    cells = table(rows, {}, {"other": 7.5}, "plan").splitlines()[-1].split(" | ")
    assert cells[1:4] == ["1.0000", "2.0000", "0.50"]
    assert cells[6:10] == ["7.5", "20.0", "25.0", "20.0"]
    assert outputs_table(rows).splitlines()[-1] == "| other | 20.0 | 30.0 |"
