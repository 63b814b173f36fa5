from me2e_compress import graph
from tests.command import Cli
from tests.frames import record
from tests.nets import conv_attention, image, turn_softmax


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


def test_the_command_says_that_nothing_differs(cli: Cli) -> None:
    record(cli.folder / "frames", [image(0)])
    graph.save(conv_attention(), cli.folder / "a.onnx")

    said = cli.done("compare a.onnx a.onnx frames --first-difference")

    assert "no difference: 3 values at 80 dB or more" in said.words


def test_two_ways_to_run_the_nodes_are_refused(cli: Cli) -> None:
    said = cli.refused("compare a.onnx a.onnx frames --first-difference --reference")

    assert "--first-difference holds two graphs together" in said
