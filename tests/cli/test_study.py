"""``study``: a report, and code that nobody trusted."""

import json
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.base.atomic import IN_JSON
from me2e_compress.simulator.routes import save_routes
from me2e_compress.study import load_study
from tests.evaluators.highway.drivers import CROSSING, straight_on
from tests.support.command import Cli, write_frames

pytestmark = pytest.mark.usefixtures("here")

STUDY = """
title = "Try"
baseline = "float"
routes = "routes.json"
held_out = "frames"

[latency]
samples = 10
baseline_median_s = 0.2

[[variant]]
name = "float"
policy = "m.onnx"

[[variant]]
name = "exact"
policy = "m.onnx"
recipe = "exact"

[[condition]]
name = "device"
latency = "trace"
"""


@pytest.fixture
def toml(tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    straight_on(tmp_path / "m.onnx")
    save_routes((CROSSING,), tmp_path / "routes.json")
    write_frames(tmp_path / "frames", command=np.array([3]))
    return path


@pytest.mark.usefixtures("toml", "short")
def test_a_study_leaves_a_report_prints_its_tables_and_json_is_the_file(
    cli: Cli, tmp_path: Path
) -> None:
    shown = cli.done("study study.toml -o out").out

    assert "Scoreboard" in shown
    assert "Difference to float" in shown
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files >= {"study.json", "tables.md", "report.html", "records", "traces"}
    text = (tmp_path / "out" / "report.html").read_text()
    assert "me2e-compress study study.toml -o" in text
    shown_json = cli.document("study study.toml -o out")
    saved = json.loads((tmp_path / "out" / "study.json").read_text())
    assert saved == IN_JSON | {k: shown_json[k] for k in saved if k in shown_json}
    assert [each["scheme"] for each in shown_json["drives"]] == ["float", "exact"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"m.onnx"\n\n',
            '"uniad"\n\n',
            "uniad: no such file; models that ship: highway",
        ),
        ('"exact"\npolicy', '"float"\npolicy', "2 variants are named float"),
    ],
)
def test_what_is_wrong_is_one_line(
    cli: Cli, toml: Path, old: str, new: str, message: str
) -> None:
    assert old in STUDY
    toml.write_text(STUDY.replace(old, new))

    assert message in cli.refused("study study.toml -o out")


@pytest.mark.usefixtures("toml")
def test_an_engine_nobody_knows(cli: Cli) -> None:
    said = cli("study study.toml -o out --engine cloud")
    assert said.code == 1
    assert "engine 'cloud'" in said.err


THEIRS = """
title = "Look"
baseline = "theirs"
routes = 1
{}

[[variant]]
name = "theirs"
policy = "{}"

[[condition]]
name = "ideal"
latency = "none"
"""
TRAP = """
from pathlib import Path
Path(__file__).with_suffix(".sprung").touch()
"""


@pytest.mark.parametrize(
    ("plugins", "policy"),
    [
        ("", "their_code:make"),
        ("", "python{factory=their_code:make}"),
        ('plugins = ["their.so"]', "blind"),
        ('provider = "cpu{plugins=[their.so]}"', "blind"),
    ],
)
def test_a_study_that_names_code_is_refused_until_it_is_trusted(
    cli: Cli, tmp_path: Path, plugins: str, policy: str
) -> None:
    (tmp_path / "their_code.py").write_text(TRAP)
    (tmp_path / "study.toml").write_text(THEIRS.format(plugins, policy))

    said = cli.refused("study study.toml -o out")

    assert said.startswith("me2e-compress: study.toml runs code: ")
    assert said.endswith("look at it first, then say --trust-code")
    if not plugins:
        trusted = load_study(tmp_path / "study.toml", trust_code=True)
        assert trusted.variants[0].policy == policy
    assert not (tmp_path / "their_code.sprung").exists()
    assert not (tmp_path / "out").exists()


def test_a_study_that_names_no_code_needs_no_trust(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(THEIRS.format("plugins = []", "blind"))
    (tmp_path / "mine.so").touch()

    assert load_study(tmp_path / "study.toml")
    mine = f"cpu{{plugins=[{tmp_path}/mine.so]}}"
    assert load_study(tmp_path / "study.toml", provider=mine)
