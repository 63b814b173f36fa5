"""Files of a stack: how they are joined, and how state begins."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.graph.stack.stack import JoinedStack
from me2e_compress.graph.stack.stack_file import PartEntry, StackFile, StateEntry
from me2e_compress.registry import documents
from me2e_compress.runtime.session import replay
from me2e_compress.runtime.stack_session import open_session
from tests.profiles import scaled
from tests.stacks import HEAD, STATE, THREE_FILES, TWO_PARTS, ones, write_stack


def bevs(path: Path, *starts: bool) -> list[float]:
    """Replay frames of ones; return the first element of the state behind each."""
    session = open_session(path, threads=1)
    return [float(v["next_bev"][0, 0]) for v in replay(session, ones(*starts))]


def test_equal_names_are_joined_and_state_runs_by_its_names(tmp_path: Path) -> None:
    path = write_stack(tmp_path)

    stack = JoinedStack.load(path)

    assert list(stack.joined.inputs) == ["prev_bev", "img"]
    assert list(stack.outputs) == ["next_bev", "plan", "feats"]
    assert stack.recurrent == {"prev_bev": "next_bev"}
    assert bevs(path, True, False, False, True) == [2.0, 3.0, 3.5, 2.0]


def test_the_first_frame_of_a_scene_has_a_file_of_its_own(tmp_path: Path) -> None:
    path = write_stack(tmp_path, THREE_FILES)

    assert bevs(path, True, False, True, False) == [20.0, 12.0, 20.0, 12.0]


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

    assert list(JoinedStack.load(path).outputs) == [
        *("next_bev", "head.plan", "backbone.plan")
    ]


@pytest.mark.parametrize(
    ("first", "expected"),
    [
        ("zeros", 2.0),
        ("bev.npy", 6.0),
        ("bev.npz", 6.0),
        ("head.learned", 2.5),
        ("backbone.feats", 3.0),
    ],
)
def test_state_begins_at_its_first_value(
    tmp_path: Path, first: str, expected: float
) -> None:
    path = write_stack(tmp_path, STATE % first)
    value = np.full(4, 8, np.float32)
    np.save(tmp_path / "bev.npy", value)
    np.savez(tmp_path / "bev.npz", prev_bev=value, another=value[:2])

    assert bevs(path, True, False, True)[::2] == [expected, expected]


def test_a_part_may_run_at_first_frames_alone(tmp_path: Path) -> None:
    path = write_stack(
        tmp_path,
        TWO_PARTS
        + '[[part]]\nname = "begin"\nfirst_frame = "begin.onnx"\n'
        + '[state]\nprev_bev = {first = "begin.bev"}\n',
        begin="""<ir_version: 9, opset_import: ["" : 17]>
        begin (float[1,4] img) => (float[1,4] bev) { bev = Neg(img) }""",
    )

    assert bevs(path, True, False) == [1.5, 2.75]
    assert "bev" not in JoinedStack.load(path).outputs


def test_what_a_frame_holds_goes_before_the_first_value(tmp_path: Path) -> None:
    session = open_session(write_stack(tmp_path, STATE % "head.learned"))
    (frame,) = ones(True)
    frame.arrays["prev_bev"] = np.full((1, 4), 20, np.float32)

    (answer,) = replay(session, [frame])

    assert answer["next_bev"][0, 0] == 12.0


def test_one_file_with_a_first_value_is_a_stack_too(tmp_path: Path) -> None:
    path = write_stack(
        tmp_path,
        '[[part]]\nname = "head"\nfile = "head.onnx"\n'
        '[state]\nprev_bev = {from = "next_bev", first = "head.learned"}\n',
    )

    assert open_session(path).first_state({})["prev_bev"].tolist() == [[1, 2, 3, 4]]


def test_state_may_be_another_output_than_its_name_says(tmp_path: Path) -> None:
    path = write_stack(tmp_path, TWO_PARTS + '[state]\nprev_bev = "feats"\n')

    assert bevs(path, True, False, False) == [2.0, 3.0, 3.0]


def test_metadata_of_the_toml_wins(tmp_path: Path) -> None:
    toml = TWO_PARTS + '[metadata]\n"me2e.plan" = {output = "plan", deltas = true}\n'

    stack = JoinedStack.load(write_stack(tmp_path, toml))

    assert (
        stack.model.metadata_props["me2e.plan"] == '{"output": "plan", "deltas": true}'
    )


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
NAME = st.from_regex(r"[A-Za-z0-9_-]{1,6}", fullmatch=True)
A = Path("a.onnx")
FILE = st.none() | NAME.map(lambda name: Path(f"{name}.onnx"))


@given(
    parts=st.lists(st.tuples(NAME, FILE), min_size=1, max_size=3),
    edges=st.dictionaries(TEXT, TEXT, max_size=2),
    state=st.dictionaries(TEXT, st.tuples(st.none() | TEXT, TEXT), max_size=2),
    metadata=st.dictionaries(TEXT, TEXT, max_size=2),
)
@settings(max_examples=scaled(40))
def test_what_is_written_is_read_again(
    parts: list[tuple[str, Path | None]],
    edges: dict[str, str],
    state: dict[str, tuple[str | None, str]],
    metadata: dict[str, str],
) -> None:
    said = StackFile(
        part=tuple(
            PartEntry(name=f"{at}{name}", file=Path("a.onnx"), first_frame=file)
            for at, (name, file) in enumerate(parts)
        ),
        edges=edges,
        state={
            n: StateEntry.model_validate({"from": to, "first": at})
            for n, (to, at) in state.items()
        },
        metadata=metadata,
    )

    assert StackFile.model_validate(documents.from_toml(said.text())) == said


def test_the_digest_is_of_all_files(tmp_path: Path) -> None:
    path = write_stack(tmp_path)
    before = graph.sha256_of(path)
    write_stack(tmp_path, head=HEAD.replace("0.5", "0.25"))

    assert graph.sha256_of(path) != before
