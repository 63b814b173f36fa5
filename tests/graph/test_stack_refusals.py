"""Files of a stack that do not fit each other: what is said, in one line."""

from pathlib import Path

import pytest

from me2e_compress.base.errors import GraphError
from me2e_compress.graph.stack.join import JoinedStack
from tests.support.stacks import HEAD, TWO_PARTS, write_stack

OTHER_FEATS = HEAD.replace("float[1,4] feats", "float[1,5] feats")
OLD = '<ir_version: 9, opset_import: ["" : 11]>'
BACKBONE_LOOP = """<ir_version: 9, opset_import: ["" : 17]>
backbone (float[1,4] img, float[1,4] next_bev) => (float[1,4] feats)
{ feats = Add(img, next_bev) }"""


@pytest.mark.parametrize(
    ("toml", "texts", "message"),
    [
        (
            TWO_PARTS,
            {"head": HEAD.replace("feats", "img_feats")},
            "nothing joins backbone to head: [edges] must say which of next_bev, plan"
            " (of head) feeds which of img (of backbone)",
        ),
        (
            TWO_PARTS,
            {"head": OTHER_FEATS},
            "head.feats takes float [1, 5], and backbone.feats, which feeds it, is"
            " float [1, 4]",
        ),
        (
            TWO_PARTS,
            {"head": HEAD.replace("float[1,4] feats", "int64[1,4] feats")},
            "head.feats takes int64 [1, 4], and backbone.feats",
        ),
        (
            TWO_PARTS + '[[part]]\nname = "neck"\nfile = "backbone.onnx"\n',
            {},
            "head.feats: backbone and neck both give feats: say backbone.feats or"
            " neck.feats, by [edges]",
        ),
        (TWO_PARTS, {"backbone": BACKBONE_LOOP}, "the parts wait for one another"),
        (TWO_PARTS.replace("head.onnx", "hat.onnx"), {}, "hat.onnx: no such file"),
        (
            TWO_PARTS + '[edges]\nfeets = "feats"\n',
            {},
            "[edges] feets: no part takes feets; there is head.feats, head.prev_bev,"
            " backbone.img",
        ),
        (
            TWO_PARTS + '[edges]\nfeats = "neck.feats"\n',
            {},
            "[edges] feats: no part gives neck.feats; there is head.next_bev,"
            " head.plan, backbone.feats",
        ),
        (
            TWO_PARTS + '[state]\nprev_bev = "plan"\n',
            {},
            "[state] prev_bev takes float [1, 4], and plan, which is fed back to it,"
            " is float [1, 2, 2]",
        ),
        (
            TWO_PARTS + '[state]\nprev_track = "next_bev"\n',
            {},
            "[state] prev_track: no part takes prev_track",
        ),
        (
            TWO_PARTS.replace("head.onnx", "../head.onnx"),
            {},
            "../head.onnx is outside the folder of the stack: not read",
        ),
        (
            TWO_PARTS,
            {"head": OLD + HEAD.replace("Sub(next_bev, learned)", "Hardmax(next_bev)")},
            "head.onnx is written in opset 11, backbone.onnx in 17, and Hardmax",
        ),
        ('[[part]]\nname = "a.b"\nfile = "head.onnx"\n', {}, "letters, digits"),
        ('[[part]]\nname = "a"\n', {}, "part.0.file: Field required"),
        (
            TWO_PARTS + 'first_frame = "first.onnx"\n',
            {},
            "part.1.first_frame: Extra inputs are not permitted",
        ),
        (
            TWO_PARTS + '[state]\nprev_bev = {first = "bev.npy"}\n',
            {},
            "state.prev_bev: Input should be a valid string",
        ),
        (TWO_PARTS.replace("backbone", "head"), {}, "two parts are called head"),
        (TWO_PARTS + "[egdes]\n", {}, "not a stack of several files: egdes: Extra"),
        ("part = 1", {}, "not a stack of several files: part:"),
        (
            TWO_PARTS + "[metadata]\nwhen = 2026-01-01\n",
            {},
            "metadata: Value error, when: Object of type date is not JSON",
        ),
        (TWO_PARTS + "[metadata]\nmost = inf\n", {}, "most: Out of range float values"),
    ],
)
def test_files_that_do_not_fit_each_other_are_one_line(
    tmp_path: Path, toml: str, texts: dict[str, str], message: str
) -> None:
    path = write_stack(tmp_path, toml, **texts)

    with pytest.raises(GraphError) as caught:
        JoinedStack.load(path)

    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
