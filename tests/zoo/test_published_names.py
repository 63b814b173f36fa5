import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.zoo.construct import construct
from me2e_compress.zoo.published_names import AVERAGE, PUBLISHED, NameMatch
from me2e_compress.zoo.stacks import STACKS
from me2e_compress.zoo.state_dict import PREFIXES
from me2e_compress.zoo.tcp.stack import Tcp
from tests.zoo.published_files import state
from tests.zoo.published_layouts import Shapes, tcp, vad_tiny
from tests.zoo.tcp.small import SMALL
from tests.zoo.uniad_layout import ANCHORS, uniad_tiny

LAYOUTS = {
    ("vad-tiny", "nuscenes"): vad_tiny(),
    ("vad-tiny", "bench2drive"): vad_tiny(classes=9, map_classes=6, modes=6),
    ("uniad-tiny", None): uniad_tiny() | ANCHORS,
    ("tcp", "bench2drive"): tcp(),
    ("tcp", "beta"): tcp("beta"),
}


def own_shapes(stack: str, heads: str | None) -> Shapes:
    with torch.device("meta"):
        model = construct(STACKS[stack].with_heads(heads))
    return {
        name: tuple(each.shape)
        for name, each in model.state_dict().items()
        if not PUBLISHED[stack].is_computed(name)
    }


def test_originals_are_of_stacks_that_are_drawn() -> None:
    drawn = {name for name, stack in STACKS.items() if not stack.trained}
    assert drawn >= PUBLISHED.keys() == {stack for stack, _ in LAYOUTS}


@pytest.mark.parametrize(("stack", "heads"), LAYOUTS)
def test_names_and_shapes_are_the_original_s(stack: str, heads: str | None) -> None:
    names = PUBLISHED[stack]
    renamed = {names.published(n): s for n, s in own_shapes(stack, heads).items()}
    layout = LAYOUTS[stack, heads]

    assert renamed == {n: s for n, s in layout.items() if not names.is_unread(n)}


@pytest.mark.parametrize(("stack", "heads"), LAYOUTS)
def test_no_two_names_become_one(stack: str, heads: str | None) -> None:
    own = own_shapes(stack, heads)
    published = {PUBLISHED[stack].published(name) for name in own}
    averages = {AVERAGE + name.replace(".", "_") for name in published}

    assert len(own) == len(published) == len(averages)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=map(str, LAYOUTS))
def test_no_name_begins_as_a_wrapper_s_prefix(layout: Shapes) -> None:
    assert [name for name in layout if name.startswith(PREFIXES)] == []


def test_lane_layers_are_told_apart() -> None:
    """They alone are called otherwise; three of the four tensors are of one shape."""
    named = PUBLISHED["vad-tiny"].published
    layer = "pts_bbox_head.lane_encoder.layer_seq.lmlp_2"

    for ours, theirs in (("linear.bias", "0.bias"), ("norm.bias", "1.bias")):
        assert named(f"{layer}.{ours}") == f"{layer}.mlp.{theirs}"


SMALL_TCP = Tcp(config=SMALL)
NAMES = sorted(dict(SMALL_TCP.named_parameters()))


@settings(max_examples=50, deadline=None)
@given(
    gone=st.sets(st.sampled_from(NAMES), max_size=5),
    more=st.sets(st.text("abc._", min_size=1, max_size=6), max_size=5),
)
def test_every_name_too_few_or_too_many_is_named(
    gone: set[str], more: set[str]
) -> None:
    whole = SMALL_TCP.state_dict()
    kept = {name: each for name, each in whole.items() if name not in gone}
    tensors = kept | dict.fromkeys(more, torch.zeros(1))

    match = NameMatch(SMALL_TCP, PUBLISHED["tcp"], state(tensors))

    assert set(match.mismatch().missing) == gone
    assert set(match.mismatch().unexpected) == more
