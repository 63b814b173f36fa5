"""Faults of a host are named; they are made here in another way than explained."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.errors import EvaluationError
from me2e_compress.fidelity import feed_search
from me2e_compress.fidelity.dump_readings import closeness, find_readings, undone
from me2e_compress.fidelity.engine_run import EngineRun
from me2e_compress.fidelity.feed_faults import Pixels, StateFault, camera_orders
from me2e_compress.fidelity.host_faults import HostFault, explain
from me2e_compress.runtime.session import Session
from tests.fidelity.hosts import MEAN, STD, Arrays, drive, frames, noisy, stack

ENGINE_DB = 45.0
"""Noise that is the engine's own."""


@functools.cache
def opened() -> Session:
    return Session(stack())


def named(
    dump: list[Arrays], *, state: bool = True, noise: float | None = ENGINE_DB
) -> tuple[HostFault, ...]:
    shown = dump if noise is None else noisy(dump, noise)
    kept = [
        {name: each for name, each in answers.items() if state or name != "prev_out"}
        for answers in shown
    ]
    pixels = {"img": Pixels(MEAN, STD)}
    return explain(EngineRun(opened(), frames(), kept), pixels)


def changed(name: str, change: Callable[[Any], Any]) -> Any:
    return lambda shown, at: (
        shown[at].arrays
        | {name: np.ascontiguousarray(change(shown[at].arrays[name]), np.float32)}
    )


def other(name: str | None, away: Callable[[int], int]) -> Any:
    def feed(shown: Any, at: int) -> Arrays:
        found = shown[min(max(away(at), 0), len(shown) - 1)].arrays
        return dict(found) if name is None else shown[at].arrays | {name: found[name]}

    return feed


def by_channel(values: tuple[float, ...]) -> Any:
    return np.array(values, np.float32).reshape(3, 1, 1)


FEEDS = {
    "frames-shifted": other(None, lambda at: at - 1),
    "input-stuck": other("ego", lambda at: 0),
    "input-late": other("img", lambda at: at - 1),
    "input-never-fed": changed("ego", np.zeros_like),
    "input-layout": changed("lidar2img", lambda x: x.swapaxes(-1, -2)),
    "input-inverse": changed("lidar2img", np.linalg.inv),
    "normalisation": changed("img", lambda x: x * by_channel(STD) + by_channel(MEAN)),
    "colours": changed(
        "img",
        lambda x: (
            (x * by_channel(STD) + by_channel(MEAN))[:, :, ::-1] - by_channel(MEAN)
        ) / by_channel(STD),
    ),
    "cameras": changed("img", lambda x: x[:, [1, 2, 0]]),
}  # fmt: skip
STATES: dict[str, Any] = {
    "state-not-reset": lambda first, starts, before: before[-1] if before else first,
    "state-late": lambda first, starts, before: (
        first if starts or len(before) < 2 or len(before) % 4 == 1 else before[-2]
    ),
    "state-never-fed": lambda first, starts, before: first,
}


@pytest.mark.parametrize("state", [True, False], ids=["state dumped", "not dumped"])
@pytest.mark.parametrize("kind", FEEDS)
def test_what_was_fed_wrongly_is_named(kind: str, state: bool) -> None:
    (fault,) = named(drive(opened(), frames(), FEEDS[kind]), state=state)

    assert fault.kind == kind
    assert fault.after_db > fault.before_db + 6
    assert fault.after_db > 25


@pytest.mark.parametrize("state", [True, False], ids=["state dumped", "not dumped"])
@pytest.mark.parametrize("kind", STATES)
def test_state_that_was_fed_wrongly_is_named(kind: str, state: bool) -> None:
    dump = drive(opened(), frames(), state=STATES[kind])
    assert [fault.kind for fault in named(dump, state=state)] == [kind]


def test_a_state_that_explains_much_does_not_hide_frames_that_are_shifted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        *(feed_search, "_screened"),
        lambda run, faults, close: [(feed_search.SURE_DB, faults[0])],
    )
    run = EngineRun(opened(), frames(), drive(opened(), frames()))

    found = feed_search.find_explanations(run, {}, {})

    assert [fault.kind for _, fault in found] == ["state-not-reset", "frames-shifted"]


def test_behind_the_first_frame_of_a_later_scene_a_late_state_is_not_judged() -> None:
    run = EngineRun(opened(), frames(), drive(opened(), frames()))
    late = StateFault("state-late", "late", "late", ("prev",))

    touched = [at for at in range(len(run)) if late.touches(run.fed, at)]

    assert touched == [1, 2, 3, 6, 7]


READS: dict[str, tuple[str, str, Callable[[Any], Any]]] = {
    "int32": ("plan", "dtype", lambda x: x.view(np.int32)),
    "big endian": ("boxes", "dtype", lambda x: x.byteswap()),
    "float16 in half of float32": (
        "boxes", "dtype", lambda x: x.astype(np.float16).view(np.float32),
    ),
    "channels last": ("boxes", "layout", lambda x: x.swapaxes(1, 2).copy()),
    "transposed in its shape": (
        "boxes", "layout", lambda x: x.swapaxes(1, 2).copy().reshape(x.shape),
    ),
    "flat": ("plan", "layout", lambda x: x.reshape(-1)),
    "scaled": ("boxes", "scale", lambda x: x * np.float32(0.25)),
    "slots": ("boxes", "slots", lambda x: x[:, [3, 0, 4, 1, 2]]),
    "state scaled": ("prev_out", "scale", lambda x: x * np.float32(3)),
}  # fmt: skip


@pytest.mark.parametrize("case", READS)
def test_what_was_read_wrongly_is_named(case: str) -> None:
    output, kind, change = READS[case]
    dump = drive(opened(), frames())
    read = [each | {output: change(each[output])} for each in dump]

    (fault,) = named(read, noise=None)

    assert (fault.kind, fault.output) == (kind, output)
    assert fault.after_db > 50


def test_frames_in_another_order_are_named() -> None:
    dump = drive(opened(), frames())
    (fault,) = named(dump[::-1])
    assert fault.said == "frames are in another order: reversed"


def test_two_faults_are_named() -> None:
    dump = drive(opened(), frames(), FEEDS["cameras"])
    read = [each | {"boxes": each["boxes"] * np.float32(7)} for each in dump]
    assert {each.kind for each in named(read)} == {"cameras", "scale"}


@pytest.mark.parametrize("decibels", [50.0, 30.0, 20.0, 10.0])
def test_noise_is_no_fault(decibels: float) -> None:
    assert named(drive(opened(), frames()), noise=decibels) == ()


@pytest.mark.parametrize(("decibels", "kinds"), [(6.0, []), (14.0, ["slots"])])
def test_an_order_that_explains_little_is_no_fault(
    decibels: float, kinds: list[str]
) -> None:
    dump = drive(opened(), frames())
    read = [each | {"boxes": each["boxes"][:, [4, 3, 2, 1, 0]]} for each in dump]

    found = named(noisy(read, decibels), noise=None)

    assert [each.kind for each in found] == kinds


def test_half_precision_is_no_fault() -> None:
    dump = drive(opened(), frames())
    half = [{n: each.astype(np.float16) for n, each in of.items()} for of in dump]
    assert named(half, noise=None) == ()


def test_little_is_tried_where_the_engine_answers_as_its_graph() -> None:
    run = EngineRun(opened(), frames(), drive(opened(), frames()))
    explain(run, {})
    assert run.inferences == len(run) + 6


def test_nothing_is_named_where_another_graph_answered() -> None:
    drawn = np.random.default_rng(0)
    dump = [
        {name: drawn.normal(0, 1, each.shape).astype(np.float32)
         for name, each in of.items()}
        for of in drive(opened(), frames())
    ]  # fmt: skip
    assert named(dump, noise=None) == ()


def test_a_number_that_is_none_is_an_error() -> None:
    dump = drive(opened(), frames())
    dump[5]["plan"][0, 1, 1] = np.nan
    with pytest.raises(EvaluationError, match=r"plan .* NaN at frame 5, \[0, 1, 1\]"):
        named(dump, noise=None)


def test_a_number_that_is_none_on_every_frame_is_an_error() -> None:
    dump = [of | {"plan": of["plan"] * np.nan} for of in drive(opened(), frames())]
    with pytest.raises(EvaluationError, match=r"plan .* NaN at frame 0, \[0, 0, 0\]"):
        named(dump, noise=None)


def test_a_size_that_nothing_explains_is_an_error() -> None:
    dump = [of | {"plan": of["plan"][:, :1]} for of in drive(opened(), frames())]
    with pytest.raises(EvaluationError, match=r"plan is \[1, 1, 2\] in the dump"):
        named(dump, noise=None)


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(3)), st.integers(0, 2**16), st.booleans())
def test_any_order_of_axes_is_found(
    order: list[int], seed: int, declared: bool
) -> None:
    drawn = np.random.default_rng(seed)
    likes = [drawn.normal(size=(2, 3, 5)) for _ in range(2)]
    values = [each.transpose(order).copy() for each in likes]
    if not declared:
        values = [each.reshape(2, 3, 5) for each in values]

    found = find_readings(values, likes)

    read = undone(found, values[1], likes[1])
    assert read is not None
    assert closeness(likes[1], read) == 60


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(6)), st.integers(0, 2**16))
def test_any_order_of_slots_is_found(order: list[int], seed: int) -> None:
    drawn = np.random.default_rng(seed)
    likes = [drawn.normal(size=(1, 6, 4)) for _ in range(2)]
    values = [each[:, order] for each in likes]

    read = undone(find_readings(values, likes), values[1], likes[1])

    assert read is not None
    assert closeness(likes[1], read) == 60


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**16), st.floats(0, 30))
def test_independent_noise_reads_as_it_stands(seed: int, decibels: float) -> None:
    drawn = np.random.default_rng(seed)
    likes = [drawn.normal(size=(1, 6, 4)) for _ in range(2)]
    level = 10 ** (-decibels / 20)
    values = [each + drawn.normal(0, level, each.shape) for each in likes]
    assert find_readings(values, likes) == ()


def test_orders_of_six_cameras_are_tried_once_each() -> None:
    orders = set(camera_orders(6))
    assert {(0, 2, 1, 3, 5, 4), (5, 4, 3, 2, 1, 0), (1, 2, 3, 4, 5, 0)} <= orders
    assert all(sorted(each) == list(range(6)) for each in orders)


def test_a_few_zeros_do_not_pass_for_bytes_of_an_integer() -> None:
    likes = [np.zeros((1, 1), np.float32)] * 3
    values = [np.full((1, 1), seconds, np.float32) for seconds in (3, 5, 7)]

    assert find_readings(values, likes) == ()
