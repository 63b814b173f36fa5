"""Files of a stack: how they are joined, and what is said where they do not fit."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.errors import FramesError, GraphError
from me2e_compress.graph.stack.stack import JoinedStack
from me2e_compress.graph.stack.stack_file import PartEntry, StackFile, StateEntry
from me2e_compress.registry import documents
from me2e_compress.runtime.session import replay
from me2e_compress.runtime.stack_session import open_session
from tests.profiles import scaled
from tests.stacks import HEAD, HEAD_FIRST, THREE_FILES, TWO_PARTS, ones, write_stack


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


STATE = TWO_PARTS + "[state]\nprev_bev = {first = %r}\n"


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


def test_a_missing_input_is_named(tmp_path: Path) -> None:
    session = open_session(write_stack(tmp_path))

    with pytest.raises(FramesError, match="input img is missing; there is prev_bev"):
        session.run({"prev_bev": np.zeros((1, 4), np.float32)})


OTHER_FEATS = HEAD.replace("float[1,4] feats", "float[1,5] feats")
BACKBONE_LOOP = """<ir_version: 9, opset_import: ["" : 17]>
backbone (float[1,4] img, float[1,4] next_bev) => (float[1,4] feats)
{ feats = Add(img, next_bev) }"""


@pytest.mark.parametrize(
    ("toml", "texts", "said"),
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
        (
            TWO_PARTS,
            {"backbone": BACKBONE_LOOP},
            "the parts wait for one another",
        ),
        (
            TWO_PARTS.replace("head.onnx", "hat.onnx"),
            {},
            "hat.onnx: no such file",
        ),
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
            STATE % "wide.npy",
            {},
            "first value wide.npy is float [1, 5], and the input takes float [1, 4]:"
            " of another stack?",
        ),
        (STATE % "none.npy", {}, "first value none.npy cannot be read"),
        (
            STATE % "one",
            {},
            "first value one is none of zeros, a file .npy or .npz, and PART.NAME",
        ),
        (
            THREE_FILES + '[state]\nprev_bev = {first = "head.learned"}\n',
            {},
            "is read by nobody: head's first_frame takes none",
        ),
        (
            THREE_FILES,
            {"head_first": HEAD_FIRST.replace("next_bev", "other_bev")},
            "frame 1: input prev_bev is missing",
        ),
        (
            TWO_PARTS.replace("head.onnx", "../head.onnx"),
            {},
            "../head.onnx is outside the folder of the stack: not read",
        ),
        (
            STATE % "/tmp/none.npy",
            {},
            "/tmp/none.npy is outside the folder of the stack: not read",
        ),
        (
            TWO_PARTS,
            {
                "head": HEAD.replace('"" : 17', '"" : 11').replace(
                    "kept = Sub(next_bev, learned)",
                    "thin = Squeeze<axes = [0]>(next_bev)"
                    " wide = Unsqueeze<axes = [0]>(thin) kept = Sub(wide, learned)",
                )
            },
            "head.onnx is written in opset 11, backbone.onnx in 17, and Squeeze",
        ),
        ('[[part]]\nname = "a.b"\nfile = "head.onnx"\n', {}, "letters, digits"),
        ('[[part]]\nname = "a"\n', {}, "a has neither file nor first_frame"),
        (TWO_PARTS.replace("backbone", "head"), {}, "two parts are called head"),
        (TWO_PARTS + "[egdes]\n", {}, "not a stack of several files: egdes: Extra"),
        ("part = 1", {}, "not a stack of several files: part:"),
        (
            TWO_PARTS + "[metadata]\nwhen = 2026-01-01\n",
            {},
            "metadata: Value error, when: Object of type date is not JSON",
        ),
        (
            TWO_PARTS + "[metadata]\nmost = inf\n",
            {},
            "metadata: Value error, most: Out of range float values",
        ),
        (STATE % "cut.npz", {}, "first value cut.npz cannot be read"),
    ],
)
def test_files_that_do_not_fit_each_other_are_one_line(
    tmp_path: Path, toml: str, texts: dict[str, str], said: str
) -> None:
    path = write_stack(tmp_path, toml, **texts)
    np.save(tmp_path / "wide.npy", np.zeros(5, np.float32))
    with zipfile.ZipFile(tmp_path / "cut.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("prev_bev.npy", b"\x93NUMPY" * 9)
    whole = (tmp_path / "cut.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole.replace(whole[42:50], b"\xff" * 8))

    with pytest.raises((GraphError, FramesError)) as caught:
        list(replay(open_session(path), ones(True, False)))

    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
