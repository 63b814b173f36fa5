"""``compare``: what differs, where first, and what is the runtime's alone."""

from pathlib import Path

import pytest

from me2e_compress import graph
from tests.support.command import Cli
from tests.support.frames import record
from tests.support.nets import conv_attention, image, turn_softmax
from tests.targets.onnxruntime.rewritten import Drawn


def test_a_graph_compared_with_itself_is_equal(cli: Cli, files: Path) -> None:
    found = cli.document("compare in.onnx in.onnx frames")
    assert [item["error"] for item in found["outputs"]] == [0.0]
    assert [item["sqnr_db"] for item in found["outputs"]] == [None]
    assert found["frames"] == 2


@pytest.fixture
def drawn(cli: Cli) -> Drawn:
    """Files of a Gemm whose int32 bias has a scale of its own, and of a float one."""
    layer = Drawn("Gemm", bias="own")
    graph.save(layer.model(), cli.folder / "own.onnx")
    graph.save(Drawn("Gemm", bias="float").model(), cli.folder / "clean.onnx")
    record(cli.folder / "frames", [layer.frame()] * 2)
    return layer


@pytest.mark.usefixtures("drawn")
def test_compare_says_what_the_runtime_answers_otherwise(cli: Cli) -> None:
    found = cli.document("compare own.onnx own.onnx frames")

    (output,) = found["outputs"]
    assert output["sqnr_db"] is None  # a file is equal to itself
    assert found["runtime"]["sqnr_db"]["y"] < 20
    assert found["runtime"]["nodes_db"] == {"y": None}
    (cause,) = found["runtime"]["causes"]
    assert cause.startswith("layer: onnxruntime's QGemm takes its int32 bias")
    said = cli.done("compare own.onnx own.onnx frames").words
    assert "answers otherwise than the file: y" in said
    found = cli.document("compare own.onnx own.onnx frames --reference")
    assert found["runtime"] is None  # it is what is compared
    assert found["outputs"][0]["sqnr_db"] < 20
    found = cli.document("compare clean.onnx clean.onnx frames")
    assert found["runtime"]["sqnr_db"] == found["runtime"]["nodes_db"] == {}
    said = cli.done("compare clean.onnx clean.onnx frames").words
    assert "answers otherwise" not in said


def test_the_command_names_the_module(cli: Cli) -> None:
    record(cli.folder / "frames", [image(0), image(1)])
    graph.save(conv_attention(), cli.folder / "a.onnx")
    wrong = conv_attention()
    turn_softmax(wrong)
    graph.save(wrong, cli.folder / "b.onnx")

    said = cli.done("compare a.onnx b.onnx frames --first-difference")

    assert "first below 80 dB: module head, y of" in said.words
    found = cli.document("compare a.onnx b.onnx frames --first-difference")
    assert found["outputs_differ"]
    assert {each["module"] for each in found["values"]} == {"backbone", "head"}
    said = cli.done("compare a.onnx a.onnx frames --first-difference")
    assert "no difference: 3 values at 80 dB or more" in said.words
    two = "compare a.onnx a.onnx frames --first-difference --reference"
    assert "--first-difference holds two graphs together" in cli.refused(two)
