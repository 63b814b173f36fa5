import onnx_ir as ir

from me2e_compress import graph
from tests.command import Cli
from tests.frames import record
from tests.nets import conv_attention, image


def test_the_command_names_module_and_node(cli: Cli) -> None:
    record(cli.folder / "frames", [image(0), image(1)])
    graph.save(conv_attention(), cli.folder / "a.onnx")
    wrong = conv_attention()
    softmax = next(node for node in wrong.graph if node.op_type == "Softmax")
    softmax.attributes["axis"] = ir.AttrInt64("axis", 1)
    graph.save(wrong, cli.folder / "b.onnx")

    said = cli.done("compare a.onnx b.onnx frames --first-difference")

    assert "first difference: module head, node /head/Softmax (Softmax)" in said.words
    found = cli.document("compare a.onnx b.onnx frames --first-difference")
    assert found["places"][0]["nodes"] == ["/head/Softmax"]


def test_the_command_says_that_nothing_differs(cli: Cli) -> None:
    record(cli.folder / "frames", [image(0)])
    graph.save(conv_attention(), cli.folder / "a.onnx")

    said = cli.done("compare a.onnx a.onnx frames --first-difference")

    assert "no difference: 10 values at 100 dB or more" in said.words


def test_two_ways_to_run_the_nodes_are_refused(cli: Cli) -> None:
    said = cli.refused("compare a.onnx a.onnx frames --first-difference --reference")

    assert "--first-difference holds two graphs together" in said
