import json
from pathlib import Path
from typing import Any

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.commands.profile import import_profile
from me2e_compress.runtime.latency_trace import LatencyTrace, read_latencies
from tests.evaluators.highway.drivers import straight_on
from tests.support.command import Cli

TIMES = [
    {"startEnqMs": 0.1, "computeMs": 49.0, "latencyMs": 50.1234, "endToEndMs": 51.0},
    {"startEnqMs": 60.1, "computeMs": 79.0, "latencyMs": 80.0},
]
LAYERS = [
    {"count": 200},
    {"name": "conv1", "timeMs": 20.0, "averageMs": 0.1, "percentage": 10.0},
    {"name": "attn", "timeMs": 40.0, "averageMs": 0.2, "medianMs": 0.2},
    {"name": "attn", "timeMs": 20.0, "averageMs": 0.1},
]


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    kinds = {"times": TIMES, "layers": LAYERS}
    return {name: write(tmp_path / f"{name}.txt", each) for name, each in kinds.items()}


def test_a_profile_of_trtexec_is_one_sample_and_its_layers(
    files: dict[str, Path],
) -> None:
    found = read_latencies(files["layers"])

    assert found.samples_us == (400,)
    assert found.layers_us == {"attn": (300,), "conv1": (100,)}


def test_what_was_measured_elsewhere_becomes_a_trace(
    tmp_path: Path, files: dict[str, Path]
) -> None:
    model, output = straight_on(tmp_path / "m.onnx"), tmp_path / "trace.json"

    found = import_profile(model, files["times"], output)

    trace = LatencyTrace.load(output)
    assert trace == found.trace
    assert trace.samples_us == (50_123, 80_000)
    assert trace.machine == "times of trtexec"
    assert found.deadlines.measures["over_budget_percent"].value == 100.0
    again = import_profile(model, output, tmp_path / "copy.json")
    assert again.trace == trace
    layers = import_profile(model, files["layers"])
    assert [row[0].text for row in layers.tables()[-1].rows] == ["attn", "conv1"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is expected: "),
        ("[", "not JSON|expected"),
        ("[]", "the file: List should have at least 1 item"),
        ([{"latencyMs": -1.0}], "0.latencyMs: Input should be greater than or equal"),
        ([{"computeMs": 1.0}], "0.latencyMs: Field required"),
        ('[{"latencyMs": NaN}]', "is expected: "),
        ([{"latencyMs": 1e300}], "0.latencyMs: Input should be less than or equal"),
        ([{"count": 3}], "List should have at least 1 item"),
        ([1, 2], "0: Input should be a valid dictionary"),
        ("{}", "not a latency trace"),
        ("RAM 5/9MB CPU [2%@729]", "is expected: "),
    ],
)
def test_a_broken_file_is_one_line(tmp_path: Path, content: Any, words: str) -> None:
    path = write(tmp_path / "broken.json", content)

    with pytest.raises(EvaluationError, match=rf"broken\.json: .*({words})") as caught:
        read_latencies(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("", "give recorded FRAMES, or --import FILE"),
        ("frames --import t", "leave FRAMES out"),
        ("--by-module --import t", "leave --by-module out"),
        ("--import missing.json", "missing.json: No such file"),
    ],
)
def test_what_does_not_go_together(
    tmp_path: Path, cli: Cli, line: str, words: str
) -> None:
    straight_on(tmp_path / "m.onnx")

    assert words in cli.refused(f"profile m.onnx {line} -o trace.json")
