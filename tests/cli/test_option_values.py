"""Values that no option takes: refused before anything is read."""

from pathlib import Path

import pytest

from tests.support.command import Cli, contents

F = "dense.onnx frames --map map.toml"


@pytest.mark.parametrize("value", ["nan", "inf", "-1", "1e+308"])
@pytest.mark.parametrize(
    "line",
    [
        f"search {F} -o out --max-mb",
        f"search {F} -o out --max-ms",
        f"search {F} -o out --max-joules",
        f"sensitivity {F} -o out --limit",
        "profile dense.onnx frames -o out --budget-ms",
        "score frames --budget-ms",
        "compare dense.onnx dense.onnx frames --alive",
    ],
)
def test_a_number_that_is_none(cli: Cli, dense: Path, line: str, value: str) -> None:
    option = line.split()[-1]

    said = cli.refused(line, value)

    assert f"{option} is {value}: it must be a finite number" in said


@pytest.mark.parametrize(
    "line",
    [
        "compress dense.onnx -r exact -o out --verify-frames -1",
        "compress dense.onnx -r exact -o out --verify-frames 1001",
        f"sensitivity {F} -o out --node-trials -1",
        "profile dense.onnx frames -o out --threads -1",
        "frames highway -n 1 -o out --seed -1",
        "evaluate blind --routes 1 -o out --seed -1",
        "evaluate --check",
        "evaluate blind",
        "routes --seed 1",
        "compres",
    ],
)
def test_words_that_no_option_takes_are_a_usage_error(
    cli: Cli, dense: Path, line: str
) -> None:
    before, said = contents(dense), cli(line)

    assert said.code == 2
    words = line.split()
    option = words[-2] if words[-1] == "-1" else ""
    assert option in said.err
    assert contents(dense) == before
