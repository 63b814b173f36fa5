"""A profile says when its figures are in doubt."""

import time
from pathlib import Path

import pytest

from me2e_compress.commands.profile import ProfileResult
from me2e_compress.runtime.latency_trace import (
    SHORTEST_S,
    LatencyTrace,
    Load,
    OthersLoad,
)


def found(others: float | None = 0.0) -> ProfileResult:
    load = None if others is None else Load(others, 2)
    trace = LatencyTrace("0", "a CPU", (7,) * 100, others=load)
    return ProfileResult(Path("m.onnx"), trace, None)


def test_a_busy_machine_is_said_last() -> None:
    (line,) = found(others=0.7).alerts()

    assert "other processes took 0.7 of 2 cores" in line
    assert found(others=0.7).status == "warning"
    assert {found(others=idle).status for idle in (None, 0.0, 0.2)} == {"ok"}


@pytest.mark.parametrize(("ours", "others"), [(2.0, 1.0), (6.0, 0.0)])
def test_what_we_take_is_not_the_others(ours: float, others: float) -> None:
    load = OthersLoad(
        machine=iter((100.0, 106.0)).__next__,
        ours=iter((1.0, 1.0 + ours)).__next__,
        clock=iter((0.0, 4.0)).__next__,
    )
    with load:
        pass

    assert load.load is not None
    assert load.load.others == others


def test_this_machine_can_tell() -> None:
    with OthersLoad() as blink:
        pass
    assert blink.load is None
    with OthersLoad() as load:
        time.sleep(1.1 * SHORTEST_S)

    assert load.load is not None
    assert 0.0 <= load.load.others <= load.load.cores + 1
