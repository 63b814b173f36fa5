"""A stack's files as one graph: how they are joined; it answers as they do; the cut."""

from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.rewrite import add_constant
from me2e_compress.graph.stack.join import End, JoinedStack
from me2e_compress.graph.stack.split import split_stack
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session, replay
from tests.support.nets import parsed
from tests.support.stacks import (
    DENSE,
    HEAD,
    TWO_PARTS,
    joined,
    ones,
    write_dense,
    write_stack,
)


def bevs(path: Path, *starts: bool) -> list[float]:
    """Replay frames of ones; return the first element of the state behind each."""
    result = replay(joined(path), ones(*starts))
    return [float(each["next_bev"][0, 0]) for each in result]


def test_equal_names_are_joined_and_state_runs_by_its_names(tmp_path: Path) -> None:
    path = write_stack(tmp_path)

    stack = JoinedStack.load(path)

    assert [each.name for each in stack.model.graph.inputs] == ["prev_bev", "img"]
    assert list(stack.names.values()) == ["next_bev", "plan", "feats"]
    assert stack.recurrent == {"prev_bev": "next_bev"}
    assert bevs(path, True, False, False, True) == [2.0, 3.0, 3.5, 2.0]
    (frame,) = ones(True)
    frame.arrays["prev_bev"] = np.full((1, 4), 20, np.float32)  # the first value
    (answer,) = replay(joined(path), [frame])
    assert answer["next_bev"][0, 0] == 12.0


def test_state_metadata_and_edges_are_what_the_toml_says(tmp_path: Path) -> None:
    state = '[state]\nprev_bev = "feats"\n[metadata]\n'
    toml = TWO_PARTS + state + '"me2e.plan" = {output = "plan", deltas = true}\n'
    path = write_stack(tmp_path, toml)

    assert bevs(path, True, False, False) == [2.0, 3.0, 3.0]
    metadata = JoinedStack.load(path).model.metadata_props
    assert metadata["me2e.plan"] == '{"output": "plan", "deltas": true}'
    toml = TWO_PARTS + '[edges]\n"head.img_feats" = "backbone.feats"\n'
    path = write_stack(tmp_path, toml, head=HEAD.replace("feats", "img_feats"))
    assert bevs(path, True, False) == [2.0, 3.0]


def test_metadata_of_the_files_that_agree_are_joined(tmp_path: Path) -> None:
    path = write_stack(tmp_path)
    said = {  # by the head, which comes first, and the backbone
        "me2e.sets": ('{"plan": 1}', '{"feats": 0}', '{"plan": 1, "feats": 0}'),
        "other": ('{"a": 1, "b": 1}', '{"a": 2}', '{"a": 2}'),
        "text": ("head", "backbone", "backbone"),
    }
    for at, part in enumerate(("head", "backbone")):
        model = graph.load(tmp_path / f"{part}.onnx")
        model.metadata_props.update({key: each[at] for key, each in said.items()})
        graph.save(model, tmp_path / f"{part}.onnx")

    metadata = JoinedStack.load(path).model.metadata_props
    assert {key: metadata[key] for key in said} == {k: v[2] for k, v in said.items()}


def again(
    stack: JoinedStack,
    folder: Path,
    toml: str = TWO_PARTS,
    whole: ir.Model | None = None,
) -> Path:
    """Split a stack's graph into a folder; return the path of a TOML beside it."""
    folder.mkdir()
    for part, model in split_stack(stack, whole or stack.model).items():
        graph.save(model, folder / f"{part}.onnx")
    (folder / "stack.toml").write_text(toml)
    return folder / "stack.toml"


def by_files(path: Path, frames: list[Frame]) -> list[dict[str, Array]]:
    """Run the files of a stack one by one; return what the frames' outputs are."""
    outputs, stack = list[dict[str, Array]](), JoinedStack.load(path)
    sessions = {
        part: Session(each.path, threads=1, optimize=False)
        for part, each in stack.parts.items()
    }
    state = dict[str, Array]()
    for frame in frames:
        if frame.starts_scene:
            state = {"prev_bev": np.zeros((4, 32), np.float32)}
        values = {End("", k): each for k, each in {**frame.arrays, **state}.items()}
        for part in stack.order:
            names = stack.parts[part].inputs
            inputs = {name: values[stack.sources[End(part, name)]] for name in names}
            ran = sessions[part].run(inputs)
            values |= {End(part, name): value for name, value in ran.items()}
        outputs.append({name: values[end] for end, name in stack.names.items()})
        state = {name: outputs[-1][answer] for name, answer in stack.recurrent.items()}
    return outputs


def images(count: int = 5) -> list[Frame]:
    draws = np.random.default_rng(0).standard_normal((count, 4, 16))
    return [
        Frame(at, at in (0, 3), {"img": draw.astype(np.float32)})
        for at, draw in enumerate(draws)
    ]


def test_the_joined_graph_answers_as_its_parts(tmp_path: Path) -> None:
    path = write_dense(tmp_path)
    stack = JoinedStack.load(path)
    weights = stack.model.graph.initializers
    file = stack.parts["backbone"].model.graph.initializers["w"]  # it is shared
    assert weights["backbone.w"].const_value is file.const_value
    assert list(weights) == ["backbone.w", "points", "head.w"]
    named = [value.name for value in stack.model.graph.outputs]
    assert named == ["next_bev", "plan", "feats"]

    whole = list(replay(joined(path), images()))

    for one, other in zip(whole, by_files(path, images()), strict=True):
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("text", ["exact", "full-fused"])
def test_what_passes_made_is_cut_and_joined_again(tmp_path: Path, text: str) -> None:
    path = write_dense(tmp_path)
    stack = JoinedStack.load(path)
    passes = tuple(each for each in recipe.load(text) if each.exact)
    manager = PassManager(passes, verify_frames=0)
    small = manager.run(stack.model, Context(ModuleMap.whole())).model

    made = again(stack, tmp_path / "small", whole=small)

    files = JoinedStack.load(made).parts
    for part, each in stack.parts.items():
        assert files[part].inputs == each.inputs
        assert files[part].outputs == each.outputs
    whole = list(replay(joined(made), images()))
    for one, other in zip(whole, by_files(path, images()), strict=True):
        for name, value in one.items():
            assert value == pytest.approx(other[name], rel=1e-5, abs=1e-6)


def test_an_older_part_is_written_in_the_opset_of_the_newest(tmp_path: Path) -> None:
    back = "Unsqueeze<axes = [0]>(t) kept = Sub(u, learned)"  # an attribute till 13
    there = f"t = Squeeze<axes = [0]>(next_bev) u = {back}"
    head = HEAD.replace("kept = Sub(next_bev, learned)", there)
    head = f'<ir_version: 9, opset_import: ["" : 11]>{head}'
    path = write_stack(tmp_path, head=head)

    assert graph.opset_of(JoinedStack.load(path).model) == 17
    plans = [each["plan"][0, 0, 0] for each in replay(joined(path), ones(True))]
    assert plans == [1.0]


def test_a_name_that_the_state_bears_twice(tmp_path: Path) -> None:
    path = write_stack(
        tmp_path,
        TWO_PARTS + '[state]\nfeats = "backbone.feats"\n',
        head=HEAD.replace("prev_bev", "other"),
    )
    frames = [
        Frame(at, not at, {**each.arrays, "other": np.zeros((1, 4), np.float32)})
        for at, each in enumerate(ones(True, False))
    ]

    session = joined(path)

    assert session.recurrent == {"feats": "backbone.feats"}
    bevs = [float(each["next_bev"][0, 0]) for each in replay(session, frames)]
    assert bevs == [0.0, 2.0]


def test_what_a_part_passes_on_keeps_its_names(tmp_path: Path) -> None:
    passing = HEAD.replace("float[1,2,2] plan)", "float[1,2,2] plan, float[1,4] feats)")
    toml = TWO_PARTS.replace("head", "neck") + "[edges]\nfeats = 'backbone.feats'\n"
    stack = JoinedStack.load(write_stack(tmp_path, toml, neck=passing))

    made = JoinedStack.load(again(stack, tmp_path / "again", toml))

    assert list(made.names.values()) == [
        "next_bev",
        "plan",
        "neck.feats",
        "backbone.feats",
    ]
    assert made.parts["neck"].inputs == stack.parts["neck"].inputs


def test_a_part_that_would_need_what_no_file_gives_is_named(tmp_path: Path) -> None:
    stack = JoinedStack.load(write_stack(tmp_path))
    (add,) = (each for each in stack.model.graph if each.op_type == "Add")
    (image,) = (each for each in stack.model.graph.inputs if each.name == "img")
    add.replace_input_with(0, image)

    with pytest.raises(GraphError, match=r"head cannot be cut out again: .* img"):
        split_stack(stack, stack.model)


def test_dense_parts_share_no_name_with_their_inner_values(tmp_path: Path) -> None:
    body = DENSE["backbone"].replace("a = MatMul(img, w) ", "plan = MatMul(img, w) ")
    body = body.replace("Relu(a)", "Relu(plan)").replace("w)", "img)")
    body = body.replace("float[4,16] img", "float[4,4] img").replace("32", "4")
    model = parsed(body)
    path = write_stack(tmp_path)
    graph.save(model, tmp_path / "backbone.onnx")
    head = HEAD.replace("float[1,4]", "float[4,4]").replace("1,2,2", "4,2,2")
    head = head.replace("learned = {1,2,3,4}", f"learned = {{{','.join('1' * 16)}}}")
    graph.save(parsed(head), tmp_path / "head.onnx")

    made = JoinedStack.load(path).model.graph

    names = [value.name for node in made for value in node.outputs]
    assert "backbone.plan" in names
    assert len(names) == len(set(names))


CALL = """
<ir_version: 9, opset_import: ["" : 17, "own" : 1]>
{name} (float[1,4] {taken}) => (float[1,4] {given}) {{ {given} = own.Twice({taken}) }}
<domain: "own", opset_import: ["" : 17]>
Twice (x) => (y) {{ y = {body} }}
"""


BRANCH = """
<ir_version: 9, opset_import: ["" : 17]>
{name} (float[1,4] {taken}) => (float[1,4] {given})
<bool yes = {{1}}, float[1] two = {{2}}> {{
    {given} = If (yes) <
        then_branch = then () => (float[1,4] inner) {{ inner = Mul({taken}, two) }},
        else_branch = other () => (float[1,4] rest) {{ rest = Identity({taken}) }}
    >
}}
"""


@pytest.mark.parametrize(("text", "functions"), [(CALL, 2), (BRANCH, 0)])
def test_functions_and_bodies_of_one_name_are_told_apart(
    tmp_path: Path, text: str, functions: int
) -> None:
    backbone = {"name": "backbone", "taken": "img", "given": "feats"}
    head = {"name": "head", "taken": "feats", "given": "plan"}
    path = write_stack(
        tmp_path,
        backbone=text.format(body="Add(x, x)", **backbone),
        head=text.format(body="Mul(x, x)", **head),
    )

    made = again(JoinedStack.load(path), tmp_path / "again")

    for each in (path, made):
        (result,) = replay(joined(each), ones(True))
        assert result["plan"][0, 0] == 4.0
    assert len(JoinedStack.load(path).model.functions) == functions


def test_large_weights_stay_on_disk(tmp_path: Path) -> None:
    path = write_dense(tmp_path)
    head = graph.load(tmp_path / "head.onnx")
    (tmp_path / "head.onnx").unlink()
    graph.save(head, tmp_path / "head.onnx", external=True)

    stack = JoinedStack.load(path)

    weight = stack.model.graph.initializers["head.w"].const_value
    assert isinstance(weight, ir.ExternalTensor)
    again(stack, tmp_path / "small")
    assert (tmp_path / "small" / "head.onnx.data").is_file()
    assert not (tmp_path / "small" / "backbone.onnx.data").exists()


def test_what_a_pass_took_away_is_missing_from_its_part(tmp_path: Path) -> None:
    stack = JoinedStack.load(write_stack(tmp_path))
    body = stack.model.graph
    (add,) = (each for each in body if each.op_type == "Add")
    (state,) = (each for each in body.inputs if each.name == "prev_bev")
    zeros = add_constant(body, np.zeros((1, 4), np.float32), "zeros")
    add.replace_input_with(1, zeros)
    body.remove(
        [each for each in body if each.op_type == "Mul" and each.name == "/head/Mul"]
    )
    body.inputs.remove(state)

    made = again(stack, tmp_path / "small")

    result = JoinedStack.load(made)
    assert [each.name for each in result.model.graph.inputs] == ["img"]
    assert result.recurrent == {}
    (answer,) = replay(joined(made), ones(True))
    assert answer["next_bev"][0, 0] == 2.0
