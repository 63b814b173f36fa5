"""A failure shrinks to the nodes that it takes."""

import onnx_ir as ir
import pytest

from me2e_compress.manager.reproducer import shrink
from tests.passes.small import ops, read

OPERATORS = ("Abs", "Neg", "Exp", "Tanh", "Cos", "Sin", "Erf")


def chain(count: int) -> ir.Model:
    """A chain of so many operators, all different."""
    calls = " ".join(
        f"v{index + 1} = {each}(v{index})"
        for index, each in enumerate(OPERATORS[:count])
    )
    inner = ", ".join(f"float[2] v{index}" for index in range(1, count))
    return read(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        f"g (float[2] v0) => (float[2] v{count}) <{inner}> {{ {calls} }}"
    )


@pytest.mark.parametrize("count", [2, 4, 7])
@pytest.mark.parametrize("guilty", range(7))
def test_one_node_is_enough(count: int, guilty: int) -> None:
    wanted = OPERATORS[guilty % count]

    found = shrink(chain(count), lambda part: wanted in ops(part))

    assert ops(found) == [wanted]


@pytest.mark.parametrize("first", [0, 2, 5])
def test_two_neighbours_stay_together(first: int) -> None:
    pair = set(OPERATORS[first : first + 2])

    found = shrink(chain(7), lambda part: pair <= set(ops(part)))

    assert pair <= set(ops(found))
    assert len(ops(found)) < 7


def test_a_failure_of_the_whole_stays_whole() -> None:
    assert ops(shrink(chain(7), lambda part: len(part.graph) == 7)) == [*OPERATORS]
