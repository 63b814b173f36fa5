import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.graph.modules.module_map import PathGlob, is_malformed

WORDS = st.text(string.ascii_lowercase + string.digits + "_", min_size=1, max_size=6)
PATHS = st.lists(WORDS, min_size=1, max_size=6).map(tuple)


@pytest.mark.parametrize(
    ("pattern", "path", "reach"),
    [
        ("img_neck", "img_neck", 1),
        ("img_neck", "img_neck.lateral_convs.0.conv.weight", 1),
        ("img_neck", "img_necklace.conv", None),
        ("img_neck", "head.img_neck", None),
        ("head.decoder", "head.decoder.layers.0", 2),
        ("head.decoder", "head.map_decoder.layers.0", None),
        ("pos_mlp*", "pos_mlp_sa.weight", 1),
        ("layers.*.norms", "layers.3.norms.1", 3),
        ("layers.?.norms", "layers.12.norms", None),
        ("*.cls_branches", "cls_branches.0", 1),
        ("*.cls_branches", "a.b.cls_branches.0", 3),
        ("**.cls_branches", "a.b.cls_branches.0", 3),
        ("*.cls_branches", "a.map_cls_branches.0", None),
        ("*.a.b", "a.b.c.a.b.d", 5),
        ("*", "anything.at.all", 1),
        ("**", "anything.at.all", 3),
        ("a.b.c", "a.b", None),
    ],
)
def test_reach(pattern: str, path: str, reach: int | None) -> None:
    assert PathGlob(pattern).reach(tuple(path.split("."))) == reach


@given(PATHS, PATHS)
def test_a_rooted_pattern_reaches_exactly_its_own_length(
    head: tuple[str, ...], tail: tuple[str, ...]
) -> None:
    assert PathGlob(".".join(head)).reach(head + tail) == len(head)


@given(PATHS, PATHS, PATHS)
def test_an_anywhere_pattern_finds_its_deepest_place(
    before: tuple[str, ...], wanted: tuple[str, ...], after: tuple[str, ...]
) -> None:
    reach = PathGlob("*." + ".".join(wanted)).reach(before + wanted + after)
    assert reach is not None
    assert reach >= len(before) + len(wanted)


@pytest.mark.parametrize("text", ["", ".", "a..b", ".a", "a.", "*."])
def test_malformed(text: str) -> None:
    assert is_malformed(text)


@pytest.mark.parametrize("text", ["a", "*.a", "**", "a.*.b"])
def test_well_formed(text: str) -> None:
    assert not is_malformed(text)
