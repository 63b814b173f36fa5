"""A stack of several files, wherever a model is asked for."""

from pathlib import Path

import numpy as np
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.driving.answer import checked
from me2e_compress.driving.contract import Observation, Trajectory
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.errors import GraphError, PreconditionError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.targets.tensorrt.tensorrt_engine import (
    EngineSettings,
    TensorRTEngine,
)
from tests.command import Command, strict
from tests.docs.documents import faults
from tests.frames import record
from tests.stacks import (
    THREE_FILES,
    TWO_MODULES,
    TWO_PARTS,
    dense_frames,
    write_dense,
    write_stack,
)


def recording(folder: Path, scenes: tuple[int, ...] = (0, 3)) -> Path:
    """Write five frames of images for the small stack."""
    images = np.random.default_rng(0).standard_normal((5, 1, 4)).astype(np.float32)
    return record(folder / "frames", [{"img": each} for each in images], scenes)


NEXT = """
<ir_version: 9, opset_import: ["" : 17]>
next (float[18] can_bus, float[1,6,2] prev_steps)
    => (float[1,6,2] plan, float[1,6,2] next_steps) <float one = {1}> {
    next_steps = Add(prev_steps, one)
    plan = Identity(next_steps)
}
"""
FIRST = f"""
<ir_version: 9, opset_import: ["" : 17]>
first (float[18] can_bus) => (float[1,6,2] plan, float[1,6,2] next_steps)
<float[1,6,2] ten = {{{", ".join(["10"] * 12)}}}> {{
    next_steps = Identity(ten)
    plan = Identity(ten)
}}
"""


def test_a_route_begins_with_the_file_for_first_frames(tmp_path: Path) -> None:
    toml = '[[part]]\nname = "n"\nfile = "next.onnx"\nfirst_frame = "first.onnx"\n'
    policy = OnnxPolicy.open(write_stack(tmp_path, toml, next=NEXT, first=FIRST))
    seen = Observation(
        0, None, np.eye(4, dtype=np.float32), np.zeros(18, np.float32), 2, 5.0
    )
    counted = list[float]()
    for _ in range(2):
        policy.reset(None)
        for _ in range(3):
            answer = checked(policy.plan(seen))
            assert isinstance(answer, Trajectory)
            counted.append(answer.points[0, 0])

    assert counted == [10, 11, 12, 10, 11, 12]


def test_what_drives_is_known_by_all_of_its_files(tmp_path: Path) -> None:
    path = write_stack(tmp_path)

    assert OnnxDriver(path).fingerprint() == sha256_of(path)


def test_profile_times_all_files_together(tmp_path: Path) -> None:
    path, trace = write_stack(tmp_path), tmp_path / "trace.json"

    me2e.profile(path, recording(tmp_path), trace)

    found = LatencyTrace.load(trace)
    assert len(found.samples_us) == 5
    assert found.model_sha256 == sha256_of(path)


def test_profile_by_module_times_the_joined_graph(tmp_path: Path) -> None:
    found = me2e.profile(
        write_stack(tmp_path),
        recording(tmp_path),
        options=me2e.ProfileOptions(by_module=True),
    )

    assert found.trace.modules_us


def test_what_feeds_every_input_of_every_file(tmp_path: Path) -> None:
    found = me2e.inspect(write_stack(tmp_path, THREE_FILES))

    assert [(each.file, each.input, each.source) for each in found.fed] == [
        ("backbone", "img", "frames"),
        ("head.first_frame", "feats", "backbone.feats"),
        ("head", "feats", "backbone.feats"),
        ("head", "prev_bev", "state: next_bev"),
    ]


def test_one_map_serves_all_files(tmp_path: Path) -> None:
    map_file = tmp_path / "map.toml"
    map_file.write_text(TWO_MODULES)

    found = me2e.inspect(write_dense(tmp_path), map_file)

    assert [(each.module, each.nodes, each.parameters) for each in found.modules] == [
        *(("a", 2, 512), ("b", 3, 1024))
    ]


def test_the_document_says_it_all(
    tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    toml = THREE_FILES.replace("head_first", "head") + (
        '[state]\nprev_bev = {first = "head.learned"}\n'
    )

    assert command("inspect", write_stack(tmp_path, toml), "--json") == 0

    found = strict(capsys.readouterr().out)
    assert faults("inspect", found) == []
    assert found["first_values"] == {"prev_bev": "head.learned"}


@pytest.mark.parametrize("toml", [None, THREE_FILES])
def test_time_is_that_of_the_joined_graph(tmp_path: Path, toml: str | None) -> None:
    stack = write_dense(tmp_path, toml) if toml else write_dense(tmp_path)

    found = me2e.inspect(stack, frames=dense_frames(tmp_path))

    assert found.latency_of


def test_lint_and_plan_take_a_stack(tmp_path: Path) -> None:
    path = write_dense(tmp_path, TWO_PARTS)

    assert not me2e.lint(path).findings
    assert len(me2e.plan(path, options=me2e.PlanOptions(scheme="full")).plan.decisions)


@pytest.mark.parametrize("toml", [TWO_PARTS, THREE_FILES])
def test_sensitivity_and_search_take_a_stack(tmp_path: Path, toml: str) -> None:
    path, frames = write_dense(tmp_path, toml), dense_frames(tmp_path)

    rows = me2e.measure_sensitivity(path, frames, tmp_path / "s.toml").records()

    assert rows
    me2e.search(path, frames, tmp_path / "r.toml", me2e.SearchOptions(max_mb=0.1))
    assert (tmp_path / "r.toml").is_file()


def test_an_engine_is_built_of_the_joined_graph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs = list[str | None]()

    def built(file: Path, settings: EngineSettings) -> TensorRTEngine:
        outputs.extend(value.name for value in graph.load(file).graph.outputs)
        raise PreconditionError("far enough")

    monkeypatch.setattr("me2e_compress.workflows.build.build_engine", built)

    with pytest.raises(PreconditionError, match="far enough"):
        me2e.build(write_stack(tmp_path), tmp_path / "m.engine")
    assert outputs == ["next_bev", "plan", "feats"]
    with pytest.raises(GraphError, match="build those of its files"):
        me2e.build(write_stack(tmp_path, THREE_FILES), tmp_path / "m.engine")
