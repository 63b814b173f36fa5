"""``compare`` says apart what onnxruntime's int8 answers otherwise than the file."""

import pytest

from me2e_compress import graph
from tests.command import Cli
from tests.frames import record
from tests.targets.onnxruntime.rewritten import Drawn


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
    assert (
        "answers otherwise than the file: y"
        in cli.done("compare own.onnx own.onnx frames").words
    )


@pytest.mark.usefixtures("drawn")
def test_nothing_is_said_of_what_it_answers_alike(cli: Cli) -> None:
    found = cli.document("compare clean.onnx clean.onnx frames")

    assert found["runtime"] == {"sqnr_db": {}, "nodes_db": {}, "causes": []}
    assert (
        "answers otherwise"
        not in cli.done("compare clean.onnx clean.onnx frames").words
    )


@pytest.mark.usefixtures("drawn")
def test_with_reference_the_runtime_is_what_is_compared(cli: Cli) -> None:
    found = cli.document("compare own.onnx own.onnx frames --reference")

    assert found["runtime"] is None
    assert found["outputs"][0]["sqnr_db"] < 20
