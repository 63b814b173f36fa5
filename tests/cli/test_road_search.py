import re
from pathlib import Path

import pytest

from tests.cli.conftest import Command


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--on-road", "give a budget: --max-mb, --max-ms or --max-joules"),
        ("--max-mb 1 --routes 4", "--routes says how to drive: add --on-road"),
        ("--max-mb 1 --workers 2", "--workers says how to drive: add --on-road"),
        ("--max-mb 1 --on-road --scheme prediction", "--modules"),
        ("--max-mb 1 --on-road --modules radar", "radar: no such module in the graph"),
        ("--max-mb 1 --on-road --ablate planner", "cannot do without it"),
        ("--max-mb 1 --on-road --latency trace:t.json", "a file is a variant's"),
        ("--max-ms 1 --on-road --target tensorrt", "use --target onnxruntime"),
        ("--max-mb 1 --on-road --routes 221", "221 routes were asked for"),
        ("--max-mb 1 --on-road --baseline-median-s 0", "a median of 0.0 s"),
    ],
)
def test_what_no_search_on_the_road_can_be_asked(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    words: str,
    message: str,
) -> None:
    done = command(
        *("search", dense / "dense.onnx", dense / "frames", *words.split()),
        *("--map", dense / "map.toml", "-o", dense / "r.toml"),
    )

    assert done == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(message, error)
    assert not (dense / "r.drives").exists()
