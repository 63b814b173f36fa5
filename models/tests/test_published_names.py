import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.published_names import AVERAGE, PUBLISHED, NameMatch
from models.stacks import STACKS
from models.state_dict import PREFIXES
from models.tcp.stack import Tcp
from models.tests.published_files import state
from models.tests.published_layouts import DIGESTS, TRAINING, digests, published
from models.tests.tcp.small import SMALL

LAYOUTS = pytest.mark.parametrize(("stack", "heads"), DIGESTS)


def test_originals_are_of_stacks() -> None:
    assert STACKS.keys() >= PUBLISHED.keys() == {stack for stack, _ in DIGESTS}


@LAYOUTS
def test_names_and_shapes_are_the_original_s(stack: str, heads: str | None) -> None:
    names = PUBLISHED[stack]
    held = published(stack, heads)

    read = {n: s for n, s in held.items() if not names.is_unread(n)}
    assert digests(read) == DIGESTS[stack, heads]
    assert held.keys() - read.keys() == set(TRAINING.get(stack, ()))


@LAYOUTS
def test_no_name_becomes_another_s_or_begins_as_a_wrapper(
    stack: str, heads: str | None
) -> None:
    names = published(stack, heads)
    averages = {AVERAGE + name.replace(".", "_") for name in names}

    assert len(names) == len(averages)
    assert [name for name in names if name.startswith(PREFIXES)] == []


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
