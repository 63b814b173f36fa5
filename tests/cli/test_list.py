import json
from pathlib import Path

import pytest

from me2e_compress import modules, recipe
from me2e_compress.workflows.listing import KINDS, REGISTRIES
from tests.cli.conftest import Command
from tests.docs.documents import faults
from tests.installed import install


def test_every_kind_is_listed_with_its_options(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("list", "--json") == 0

    found = json.loads(capsys.readouterr().out)
    assert faults("list", found) == []
    assert set(found) >= set(KINDS)
    for kind, registry in REGISTRIES.items():
        assert [entry["name"] for entry in found[kind]] == list(registry.names())
    assert [entry["name"] for entry in found["recipes"]] == recipe.shipped()
    maps = [entry["name"] for entry in found["module-maps"]]
    assert maps == [*modules.presets(), "whole"]
    blind = next(each for each in found["policies"] if each["name"] == "blind")
    assert [option["name"] for option in blind["options"]] == ["speed_mps"]


@pytest.mark.parametrize("kind", KINDS)
def test_ours_can_all_be_used_and_say_what_they_are(kind: str) -> None:
    for entry in KINDS[kind]():
        assert not entry.error
        assert entry.doc
        for option in entry.options:
            assert option.doc, f"{entry.name}: {option.name}"


def test_one_kind_shows_what_its_options_mean(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("list", "observers") == 0

    text = " ".join(capsys.readouterr().out.split())
    assert "\\n" not in text
    assert "percent: float = 99.99 above 0 and at most 100" in text
    assert "quantize-int8" not in text


def test_a_broken_entry_is_named_and_the_rest_is_shown(
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    entry = {"bad": "no_such_module:Bad"}
    install(monkeypatch, tmp_path, "bad-package", "me2e_compress.targets", entry)

    assert command("list", "targets") == 0

    text = " ".join(capsys.readouterr().out.split())
    assert "target 'bad' of bad-package 1.0" in text
    assert "onnxruntime" in text


def test_no_such_kind(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("list", "wheels") == 1
    assert "no kind 'wheels'; there are passes, rules" in capsys.readouterr().err
