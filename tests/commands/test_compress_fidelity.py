"""``compress`` measures what it did, warns, and names the command that finds why."""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.compress import size_note, speed_note
from me2e_compress.commands.outcome import ADVICE
from me2e_compress.runtime.providers import CPU
from tests.support.command import Command
from tests.support.frames import record
from tests.support.nets import map_text, net

PROJECTION = """
net (float[1,8,64] img, float[6,4,4] lidar2img, float[4,256] points,
     float[64,64] first, float[64,64] second, float[64,12] out)
    => (float[1,6,2] plan, float[6,2,256] bev)
    <int64[1] zero = {0}, int64[1] two = {2}, int64[1] three = {3}, int64[1] row = {1},
     float least = {0.1}, float width = {800.0}, int64[3] waypoints = {1, 6, 2}> {
    ["/backbone/first"] a = MatMul(img, first)
    ["/backbone/Relu"] r = Relu(a)
    ["/backbone/second"] b = MatMul(r, second)
    ["/bev_encoder/project"] seen = MatMul(lidar2img, points)
    ["/bev_encoder/uv"] uv = Slice(seen, zero, two, row)
    ["/bev_encoder/z"] z = Slice(seen, two, three, row)
    ["/bev_encoder/Max"] depth = Max(z, least)
    ["/bev_encoder/Div"] pixel = Div(uv, depth)
    ["/bev_encoder/Scale"] share = Div(pixel, width)
    ["/bev_encoder/Tanh"] bev = Tanh(share)
    ["/plan_head/mean"] mean = ReduceMean<axes=[1]>(b)
    ["/plan_head/out"] flat = MatMul(mean, out)
    ["/plan_head/Reshape"] plan = Reshape(flat, waypoints)
}
"""

MAP = map_text(backbone="feature", bev_encoder="feature", plan_head="prediction")


def projection() -> ir.Model:
    """Layers, and a product of camera matrices with points in front of the car."""
    random = np.random.default_rng(0)
    points = np.ones((4, 256))
    points[0], points[1] = random.uniform(-8, 8, (2, 256))
    points[2] = random.uniform(4, 40, 256)
    layers = {"first": (64, 64), "second": (64, 64), "out": (64, 12)}
    weights = {name: random.normal(0, 0.1, size) for name, size in layers.items()}
    return net(PROJECTION, {**weights, "points": points})


def camera_frame(seed: int) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    camera = np.eye(4)
    camera[0, 0] = camera[1, 1] = 1200.0
    camera[:2, 2] = 800.0
    cameras = camera + random.normal(0, 0.01, (6, 1, 1))
    image = random.standard_normal((1, 8, 64))
    return {"img": image.astype("f"), "lidar2img": cameras.astype("f")}


@pytest.fixture
def cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the graph, its map and eight frames; the current one."""
    graph.save(projection(), tmp_path / "in.onnx")
    (tmp_path / "map.toml").write_text(MAP)
    record(tmp_path / "frames", [camera_frame(seed) for seed in range(8)])
    monkeypatch.chdir(tmp_path)
    return tmp_path


PAPER = (
    *("compress", "in.onnx", "--scheme", "full", "--rules", "paper"),
    *("--map", "map.toml", "--frames", "frames", "--verify-frames", 0),
    *("-o", "out.onnx"),
)


def test_lost_quality_is_named_with_the_command_that_finds_where(
    command: Command, cameras: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The camera projection in int8: depths of metres on a scale of pixels."""
    assert command(*PAPER) == 0

    said = capsys.readouterr().out
    assert "below the floor (20 dB, 0.5 m of plan): bev" in said
    nodes = "/backbone/first, /backbone/second, /bev_encoder/project"
    assert f"; lost in quantize-int8 ({nodes})\n" in said
    assert f"\n{ADVICE} measures which modules lose it\n" in said

    how = ("--rules", "paper", "--map", "map.toml", "-o", "r.toml")
    assert command("sensitivity", "in.onnx", "frames", *how) == 0
    table = capsys.readouterr().out
    (row,) = (line for line in table.splitlines() if line.startswith("bev_encoder"))
    assert float(row.split()[-1]) < 20
    override = '[[override]]\nmodule = "bev_encoder"\ndtype = "float"\n'
    (cameras / "more.toml").write_text(override)
    assert command(*PAPER, "--overrides", "more.toml") == 0
    assert "below the floor" not in capsys.readouterr().out
    assert command(*PAPER, "--floor", 0) == 0
    said = capsys.readouterr().out
    assert "below the floor" not in said
    assert "the noisiest output is bev" in said


def test_the_report_holds_the_measurement_and_the_command(
    cameras: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One calibration of the frames, and of those kept out no second."""
    options = me2e.CompressOptions(
        scheme="full", rules="paper", module_map="map.toml", verify_frames=0
    )
    ran, whole = list[int](), Calibrator.run

    def counted(self: Calibrator, *given: Any) -> Any:
        ran.append(1)
        return whole(self, *given)

    monkeypatch.setattr(Calibrator, "run", counted)
    found = me2e.compress("in.onnx", "out.onnx", frames="frames", options=options)

    assert len(ran) == 1
    assert found.loss is not None
    assert [each.output for each in found.loss.shortfalls] == ["bev"]
    told = json.loads((cameras / "out.report.json").read_text())
    assert told["fidelity"]["on"] == "kept out of calibration"
    fidelity = told["fidelity"]["fidelity"]
    assert (fidelity["frames"], fidelity["seen"]) == (3, 5)
    assert told["fidelity"]["guilty"] == ["quantize-int8"]
    assert told["fidelity"]["advice"] == ADVICE
    floor = {"sqnr_db": 20.0, "plan_m": 0.5}
    assert told["fidelity"]["floor"] == floor
    lines = [each for each in found.lines()[:-2] if each != found.slower]
    assert told["verdict"] == [*lines, *found.alerts()]
    (note,) = [n for n in told["steps"][-1]["notes"] if "calibrated" in n]
    assert note.endswith("calibrated on 5 frames")

    options = dataclasses.replace(options, measure_frames=0)
    found = me2e.compress("in.onnx", "out.onnx", frames="frames", options=options)
    assert found.loss is not None
    assert found.loss.fidelity is None
    assert any("on 8 frames" in note for note in found.report.steps[-1].notes)
    found = me2e.compress("in.onnx", "out.onnx", "exact", "frames")
    assert found.loss is None
    assert "every output is the same" in found.lines()[0]
    assert not found.alerts()


def test_one_frame_is_calibrated_and_measured_on_and_that_is_said(
    command: Command, cameras: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(cameras / "one", [camera_frame(0)])
    once = [*PAPER[: PAPER.index("frames")], "one", *PAPER[PAPER.index("frames") + 1 :]]

    assert command(*once) == 0

    said = capsys.readouterr().out
    assert "calibrated on as well: there is no other" in said
    assert "this verdict rests on 1 frame: record 9 or more" in said
    assert "liveness: not measured (one frame alone" in said


def test_an_output_that_int8_freezes_is_an_alert(
    command: Command, cameras: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Saved ranges a million times too large: the plan is the same in every frame."""
    calibrate = ("calibrate", "in.onnx", "frames", "-o", "ranges.json")
    assert command(*calibrate, "--map", "map.toml", "--method", "max-min") == 0
    ranges = json.loads((cameras / "ranges.json").read_text())
    ranges["tensors"] = {
        name: [1e6 * bound for bound in bounds]
        for name, bounds in ranges["tensors"].items()
    }
    (cameras / "ranges.json").write_text(json.dumps(ranges))
    capsys.readouterr()

    how = ("--target", "tensorrt", "--ranges", "ranges.json", "--floor", 0)
    assert command(*PAPER, *how) == 0

    said = capsys.readouterr().out
    assert "\nplan is constant: it moves 0.00% as far as before" in said


LOGARITHM = """
net (float[1,16,16] x, float[16,16] w) => (float[1,16,16] y) {
    ["/backbone/MatMul"] a = MatMul(x, w)
    ["/backbone/Abs"] b = Abs(a)
    ["/backbone/Log"] y = Log(b)
}
"""


def test_an_output_that_is_no_longer_finite_is_not_overlooked(tmp_path: Path) -> None:
    """A small product is zero in int8, and its logarithm infinite."""
    weight = np.ones((16, 16))
    graph.save(net(LOGARITHM, {"w": weight}), tmp_path / "in.onnx")
    values = np.full((1, 16, 16), 1e-3, np.float32)
    values[0, 0] = 10.0
    record(tmp_path / "frames", [{"x": values}])
    (tmp_path / "map.toml").write_text(map_text(backbone="feature"))
    options = me2e.CompressOptions(
        scheme="full", rules="paper", module_map=tmp_path / "map.toml"
    )

    found = me2e.compress(
        tmp_path / "in.onnx", tmp_path / "o.onnx", None, tmp_path / "frames", options
    )

    assert "y: 0.94 of it is a number in one graph alone" in found.alerts()
    assert any(
        "below the floor (20 dB, 0.5 m of plan): y -inf dB" in each
        for each in found.alerts()
    )
    assert found.status == "warning"


@pytest.mark.usefixtures("cameras")
def test_a_file_that_is_larger_or_no_faster_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = me2e.CompressOptions(scheme="full", rules="paper", module_map="map.toml")
    found = me2e.compress("in.onnx", "out.onnx", frames="frames", options=options)

    more = size_note(found.output, found.source)
    count = found.source_bytes - found.output_bytes
    assert more.startswith(f"in.onnx is {count:,} bytes larger than out.onnx: origins")
    assert found.larger == ""
    assert more in dataclasses.replace(found, larger=more).summary_lines()
    # one second of the source, then so many of what was written
    slower, faster = "out.onnx takes 2.00 times as long as in", "OpenVINO runs out.onnx"
    for seconds, missing, said in ((2, "ov", slower), (0.9, "ov", ""), (2, "", faster)):
        where = "me2e_compress.commands.compress.missing_module"
        monkeypatch.setattr(where, lambda _, missing=missing: missing)
        clock = itertools.accumulate(itertools.cycle([0, 1, 0, seconds]))
        monkeypatch.setattr("time.process_time", clock.__next__)
        taken = speed_note(found.source, found.output, CalibrationSet("frames"), CPU)
        assert (taken[: len(said)], bool(taken)) == (said, bool(said))


def test_stack_traces_of_an_exporter_are_dropped(tmp_path: Path) -> None:
    text = "n (float[4] x) => (float[4] y) { y = Relu(x) }"
    model = net(text, {})
    model.graph[0].doc_string = "/home/somebody/model.py(17): forward"
    model.graph[0].metadata_props["pkg.torch.onnx.stack_trace"] = "/home/somebody"
    graph.save(model, tmp_path / "in.onnx")

    me2e.compress(tmp_path / "in.onnx", tmp_path / "out.onnx", "exact")

    assert b"somebody" not in (tmp_path / "out.onnx").read_bytes()
