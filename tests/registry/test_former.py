"""A name of 0.2 that is gone is refused in one line, which says what replaces it."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress.calibration.observers import OBSERVERS, MaxMin
from me2e_compress.errors import FORMER_NAMES, RecipeError
from me2e_compress.manager import recipe
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.registry import Registry
from tests.support.command import Cli
from tests.support.installed import install


@pytest.mark.parametrize(
    ("line", "instead"),
    [
        ("inspect highway --modelled-energy 7nm", ""),
        ("build m.onnx -o m.engine", "trtexec"),
        ("score results --modelled a=1", ""),
        ("plan highway --weight-only-gemv", "--rules 'safe{without=[gemv]}'"),
        ("plan highway --weight-only-gemv=1", "--rules 'safe{without=[gemv]}'"),
        ("compress highway -o m.onnx --weight-only-gemv", "--rules 'safe{without="),
        ("search highway frames -o r.toml --max-mb 5 --on-road", "a study"),
        ("study s.toml -o out --records out/records", "python -m benchmarks.paper"),
        ("export vad-tiny --opset 13 -o m.onnx", "python -m models.export"),
        ("demo --stack vad-tiny", "python -m models.export"),
        ("plan a.onnx --set-dim batch=1", "compress M.onnx -r exact --set-dim"),
        ("compress a.onnx -o b.onnx --allow-empty", "-r exact"),
        ("evaluate blind -o out --dt-ms 25", "a study's dt_ms"),
        ("routes --examine set.json", ""),
        ("compare a.onnx b.onnx frames --plugins c.so", "--provider 'cpu{plugins=["),
    ],
)
def test_an_option_that_is_gone_is_a_usage_error(
    line: str, instead: str, cli: Cli
) -> None:
    refused = cli(line)

    assert refused.code == 2
    assert f"is gone since 0.3.0: use {instead}" in refused.err
    assert "gone since" not in cli("frames none.onnx --seed 1 -o made").err


def test_what_is_named_instead_is_taken() -> None:
    assert RULE_SETS.parse("safe{without=[gemv]}").without == ("gemv",)
    assert recipe.parse("quantize-int8{rules=safe{without=[gemv]}}")
    for method in ("mse", "max-min", "percentile"):
        assert OBSERVERS.parse(method).name == method


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("evaluate expert -o out", "expert is gone since 0.3.0: use models.driver.ex"),
        ("export tcp -o m.onnx", "tcp is gone since 0.3.0: use a file: python -m mode"),
        ("frames tcp -o made", "tcp is gone since 0.3.0: use a file: python -m models"),
        (
            "calibrate highway frames -o r.json --method moving-average:0.1",
            "moving-average is gone since 0.3.0: use max-min",
        ),
        (
            "study s.toml -o out",
            "s.toml: [[scheme]] is gone since 0.3.0: use [[variant]]",
        ),
    ],
)
def test_a_name_that_is_gone_is_one_line(
    line: str, words: str, cli: Cli, tmp_path: Path
) -> None:
    (tmp_path / "s.toml").write_text('[[scheme]]\nname = "a"\n')

    assert cli.refused(line).startswith(f"me2e-compress: {words}")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            "quantize-int8{weight_only_gemv=true}",
            "weight_only_gemv is gone since 0.3.0: use rules=safe{without=[gemv]}",
        ),
        ("fold-constants{growth=0}", "growth is gone since 0.3.0: use bytes_per_node"),
        (
            "fuse-operators{tolerance=0.1}",
            "tolerance is gone since 0.3.0: it has one value",
        ),
        (
            "fuse-basic{swish=true}",
            "swish is gone since 0.3.0: onnxruntime has no kernel",
        ),
        (
            "static-geometry",
            "static-geometry is gone since 0.3.0: use freeze-inputs, with --frames",
        ),
    ],
)
def test_a_pass_or_an_option_of_one_that_is_gone(text: str, line: str) -> None:
    with pytest.raises(RecipeError) as refused:
        recipe.parse(text)
    assert str(refused.value) == line


@dataclass(frozen=True)
class Entropy(MaxMin):
    """Of another package, by a name that was ours."""

    name: ClassVar[str] = "entropy"


def test_another_package_may_bring_a_name_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = {"entropy": f"{__name__}:Entropy"}
    install(monkeypatch, tmp_path, "an-entropy", "me2e_compress.observers", entry)

    assert OBSERVERS.parse("entropy") == Entropy()


def test_a_name_is_gone_of_its_own_kind_alone() -> None:
    assert "calibration method entropy" in FORMER_NAMES
    others = Registry[MaxMin]("policy", "none.of.these", RecipeError, {})
    with pytest.raises(RecipeError, match="no policy 'entropy'; there are none"):
        others.get("entropy")
