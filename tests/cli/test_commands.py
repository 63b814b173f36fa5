"""Every command explains itself; what list, doctor, lint and export answer."""

import re
from pathlib import Path

import pytest

from me2e_compress import graph
from me2e_compress.cli.app import COMMANDS
from me2e_compress.cli.console import print_json
from me2e_compress.commands.frames import FramesResult
from me2e_compress.commands.listing import KINDS, REGISTRIES
from me2e_compress.commands.options import FramesOptions
from me2e_compress.graph.modules.module_map import presets
from me2e_compress.manager import recipe
from tests.docs.documents import faults
from tests.docs.pages import ROOT
from tests.support.command import Cli, strict
from tests.support.installed import install
from tests.support.nets import parsed, save_text

NAMES = sorted(COMMANDS)
TWIST = (
    '<ir_version: 9, opset_import: ["" : 17, "own" : 1]>'
    "m (float[2] x) => (float[2] y) { a = own.Twist(x) b = own.Twist(a)"
    " c = own.Twist(b) d = own.Twist(c) y = own.Twist(d) }"
)


@pytest.mark.parametrize("name", NAMES)
def test_every_command_explains_itself_and_is_documented(cli: Cli, name: str) -> None:
    assert name in cli.done(f"{name} --help").out
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert re.search(rf"^\* `me2e-compress {name}\b", page, re.MULTILINE)
    assert f"`{name}`" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_doctor_names_the_versions(cli: Cli) -> None:
    document = cli.document("doctor")
    found = {item["what"]: item["found"] for item in document["checkups"]}
    assert found["onnxruntime"]


def test_every_kind_is_listed_with_its_options(cli: Cli) -> None:
    found = cli.document("list")

    assert set(found) >= set(KINDS)
    for kind, registry in REGISTRIES.items():
        assert [entry["name"] for entry in found[kind]] == list(registry.names())
    assert [entry["name"] for entry in found["recipes"]] == recipe.shipped()
    maps = [entry["name"] for entry in found["module-maps"]]
    assert maps == [*presets(), "whole"]
    blind = next(each for each in found["policies"] if each["name"] == "blind")
    assert [option["name"] for option in blind["options"]] == ["speed_mps"]


@pytest.mark.parametrize("kind", KINDS)
def test_ours_can_all_be_used_and_say_what_they_are(kind: str) -> None:
    for entry in KINDS[kind]():
        assert not entry.error
        assert entry.doc
        for option in entry.options:
            assert option.doc, f"{entry.name}: {option.name}"


def test_one_kind_shows_what_its_options_mean(cli: Cli) -> None:
    text = cli.done("list observers").words

    assert "\\n" not in text
    assert "percent: float = 99.99 above 0 and at most 100" in text
    assert "quantize-int8" not in text


def test_a_broken_entry_is_named_and_the_rest_is_shown(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = {"bad": "no_such_module:Bad"}
    install(monkeypatch, tmp_path, "bad-package", "me2e_compress.targets", entry)

    text = cli.done("list targets").words

    assert "target 'bad' of bad-package 1.0" in text
    assert "onnxruntime" in text


def test_what_would_be_refused_is_listed_and_fails(cli: Cli, tmp_path: Path) -> None:
    graph.save(parsed(TWIST), tmp_path / "twist.onnx")

    said = cli("lint twist.onnx")
    assert said.code == 1
    assert "error plugin: 2 more" in said.out
    (line,) = said.err.strip().splitlines()
    assert "tensorrt refuses it, 5 errors; plugin 'a': own::Twist is neither" in line
    assert "more" not in cli("lint twist.onnx -v").out
    found = cli.document("lint twist.onnx", code=1)
    assert found["status"] == "refused"
    assert [each["rule"] for each in found["findings"]] == ["plugin"] * 5
    assert found["tensorrt_rtx"] is None


def test_a_version_refuses_what_came_later(cli: Cli, tmp_path: Path) -> None:
    text = "m (int64[2] x, int64[2] p) => (int64[2] y) { y = Pow(x, p) }"
    save_text(tmp_path / "m.onnx", text)

    done = cli("lint m.onnx --target-version 8.6.1.2")

    assert "m.onnx for tensorrt 8.6.1.2: 1 error, 0 warnings" in done.out
    assert done.code == 1


def test_trt_check_says_what_was_asked_and_of_whom(cli: Cli, dense: Path) -> None:
    pytest.importorskip("tensorrt_rtx")

    said = cli.done("lint dense.onnx --trt-check").out

    assert "TensorRT-RTX 1" in said
    assert "parsed, built for SM86\n" in said


def test_frames_that_there_are_count_not_those_asked_for(
    cli: Cli, tmp_path: Path
) -> None:
    for name in ("000000.npz", "000001.npz"):
        (tmp_path / name).touch()

    print_json(FramesResult.of("highway", tmp_path, FramesOptions(count=3)).document())

    found = strict(cli.capsys.readouterr().out)
    assert faults("frames", found) == []
    assert found["frames"] == 2
