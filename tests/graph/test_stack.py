"""Files of a stack: how they are joined."""

from pathlib import Path

import numpy as np

from me2e_compress.graph.stack.join import JoinedStack
from me2e_compress.runtime.session import replay
from tests.stacks import HEAD, TWO_PARTS, joined, ones, write_stack


def bevs(path: Path, *starts: bool) -> list[float]:
    """Replay frames of ones; return the first element of the state behind each."""
    found = replay(joined(path), ones(*starts))
    return [float(each["next_bev"][0, 0]) for each in found]


def test_equal_names_are_joined_and_state_runs_by_its_names(tmp_path: Path) -> None:
    path = write_stack(tmp_path)

    stack = JoinedStack.load(path)

    assert [each.name for each in stack.model.graph.inputs] == ["prev_bev", "img"]
    assert list(stack.names.values()) == ["next_bev", "plan", "feats"]
    assert stack.recurrent == {"prev_bev": "next_bev"}
    assert bevs(path, True, False, False, True) == [2.0, 3.0, 3.5, 2.0]


def test_edges_name_what_is_called_otherwise(tmp_path: Path) -> None:
    path = write_stack(
        tmp_path,
        TWO_PARTS + '[edges]\n"head.img_feats" = "backbone.feats"\n',
        head=HEAD.replace("feats", "img_feats"),
    )

    assert bevs(path, True, False) == [2.0, 3.0]


def test_two_outputs_of_one_name_are_called_by_their_parts(tmp_path: Path) -> None:
    path = write_stack(
        tmp_path,
        TWO_PARTS + "[edges]\nimg_feats = 'backbone.plan'\n",
        head=HEAD.replace("feats", "img_feats"),
        backbone="""<ir_version: 9, opset_import: ["" : 17]>
        backbone (float[1,4] img) => (float[1,4] plan) { plan = Add(img, img) }""",
    )

    assert list(JoinedStack.load(path).names.values()) == [
        *("next_bev", "head.plan", "backbone.plan")
    ]


def test_what_a_frame_holds_is_the_first_value(tmp_path: Path) -> None:
    session = joined(write_stack(tmp_path))
    (frame,) = ones(True)
    frame.arrays["prev_bev"] = np.full((1, 4), 20, np.float32)

    (answer,) = replay(session, [frame])

    assert answer["next_bev"][0, 0] == 12.0


def test_state_may_be_another_output_than_its_name_says(tmp_path: Path) -> None:
    path = write_stack(tmp_path, TWO_PARTS + '[state]\nprev_bev = "feats"\n')

    assert bevs(path, True, False, False) == [2.0, 3.0, 3.0]


def test_metadata_of_the_toml_wins(tmp_path: Path) -> None:
    toml = TWO_PARTS + '[metadata]\n"me2e.plan" = {output = "plan", deltas = true}\n'

    stack = JoinedStack.load(write_stack(tmp_path, toml))

    assert (
        stack.model.metadata_props["me2e.plan"] == '{"output": "plan", "deltas": true}'
    )
