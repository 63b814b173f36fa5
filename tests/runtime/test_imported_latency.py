import json
from pathlib import Path
from typing import Any

import pytest

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.imported_latency import read_imports
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.workflows.profile import import_profile
from tests.command import Cli, cli, command
from tests.evaluators.highway.drivers import straight_on

__all__ = ["cli", "command"]

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
LOG = """11-22-2026 17:15:02 RAM 5123/30536MB CPU [2%@729] GR3D_FREQ 0% cpu@45.2C VDD_GPU_SOC \
5000mW/5000mW VDD_CPU_CV 1200mW/1200mW
11-22-2026 17:15:03 RAM 5123/30536MB VDD_GPU_SOC 9000mW/7000mW/9000mW VDD_CPU_CV 1400mW/1300mW/1400mW
"""  # noqa: E501


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    kinds = {"times": TIMES, "layers": LAYERS, "log": LOG}
    return {name: write(tmp_path / f"{name}.txt", each) for name, each in kinds.items()}


def test_a_profile_of_trtexec_is_one_sample_and_its_layers(
    files: dict[str, Path],
) -> None:
    found = read_imports([files["layers"]])

    assert found.samples_us == (400,)
    assert found.layers_us == {"attn": (300,), "conv1": (100,)}


def test_rails_of_tegrastats_beside_times(files: dict[str, Path]) -> None:
    found = read_imports([files["log"], files["times"]])

    assert found.rails_w == {"VDD_GPU_SOC": (5.0, 9.0), "VDD_CPU_CV": (1.2, 1.4)}
    assert found.power[0] == (
        "VDD_GPU_SOC: 7.00 W on average, 9.00 W at most, over 2 samples (tegrastats)"
    )
    assert len(found.samples_us) == 2


def test_what_was_measured_elsewhere_becomes_a_trace(
    tmp_path: Path, files: dict[str, Path]
) -> None:
    model, output = straight_on(tmp_path / "m.onnx"), tmp_path / "trace.json"

    found = import_profile(model, [files["times"], files["layers"]], output)

    trace = LatencyTrace.load(output)
    assert trace == found.trace
    assert trace.samples_us == (50_123, 80_000)
    assert trace.machine == "times of trtexec and a profile of trtexec"
    assert found.deadlines.over_percent.value == 100.0
    assert [row[0].text for row in found.tables()[-1].rows] == ["attn", "conv1"]
    again = import_profile(model, [output], tmp_path / "copy.json")
    assert again.trace == trace


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "no power of a rail in it"),
        ("[", "not JSON|expected"),
        ("[]", "the file: List should have at least 1 item"),
        ([{"latencyMs": -1.0}], "0.latencyMs: Input should be greater than or equal"),
        ([{"computeMs": 1.0}], "0.latencyMs: Field required"),
        ('[{"latencyMs": NaN}]', "is expected: "),
        ([{"latencyMs": 1e300}], "0.latencyMs: Input should be less than or equal"),
        ([{"count": 3}], "List should have at least 1 item"),
        ([1, 2], "0: Input should be a valid dictionary"),
        ("{}", "not a latency trace"),
        ("RAM 5/9MB CPU [2%@729]", "no power of a rail in it"),
        (LOG, "no latency in it"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path: Path, content: Any, words: str) -> None:
    path = write(tmp_path / "broken.json", content)

    with pytest.raises(EvaluationError, match=rf"broken\.json: .*({words})") as caught:
        read_imports([path])
    assert "\n" not in str(caught.value)


def test_a_folder_of_files_or_of_none(tmp_path: Path, files: dict[str, Path]) -> None:
    model, folder = straight_on(tmp_path / "m.onnx"), tmp_path / "run"
    folder.mkdir()
    with pytest.raises(EvaluationError, match="run: there is no file in it"):
        import_profile(model, [folder])
    for name in ("times", "log"):
        files[name].rename(folder / name)

    found = import_profile(model, [folder])

    assert len(found.trace.samples_us) == 2
    assert "VDD_GPU_SOC: 7.00 W on average" in found.lines()[0]


def test_two_files_of_one_kind_are_refused(files: dict[str, Path]) -> None:
    with pytest.raises(EvaluationError, match="a second file of the same kind"):
        read_imports([files["times"], files["times"]])


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
