"""A failure shrinks to the nodes that it takes, and is written beside what is there."""

from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress.manager import reproducer
from me2e_compress.manager.reproducer import shrink
from tests.passes.small import ops, read
from tests.support.nets import DRIVER, parsed

OPERATORS = ("Abs", "Neg", "Exp", "Tanh", "Cos", "Sin", "Erf")


def chain(count: int) -> ir.Model:
    """A chain of so many operators, all different."""
    calls = " ".join(
        f"v{index + 1} = {each}(v{index})"
        for index, each in enumerate(OPERATORS[:count])
    )
    inner = ", ".join(f"float[2] v{index}" for index in range(1, count))
    return read(f"g (float[2] v0) => (float[2] v{count}) <{inner}> {{ {calls} }}")


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


def test_a_folder_of_the_user_is_left_alone(tmp_path: Path) -> None:
    theirs = tmp_path / "reproducer-fold-constants"
    theirs.mkdir()
    (theirs / "model.onnx").write_text("theirs")
    model = parsed(DRIVER)

    made = [
        reproducer.write(tmp_path, model, "fold-constants", 0, "broke").name
        for _ in range(2)
    ]

    assert made == ["reproducer-fold-constants-2"] * 2
    assert (theirs / "model.onnx").read_text() == "theirs"
    assert len(list(tmp_path.iterdir())) == 2
