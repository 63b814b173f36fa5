"""Which outputs come back as inputs."""

import re

import numpy as np
import pytest

from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.graph.recurrence import SessionPort, not_fed_back, recurrence
from me2e_compress.runtime.session import Session
from tests.support.nets import conv_attention

STATE = SessionPort("tensor(float)", (1, 8))
FLAG = SessionPort("tensor(bool)", (1,))


def pairs(inputs: str, outputs: str, metadata: str | None = None) -> dict[str, str]:
    sides = [dict.fromkeys(names.split(), STATE) for names in (inputs, outputs)]
    told = {} if metadata is None else {"me2e.recurrent": metadata}
    return recurrence(told, *sides)


def test_a_pair_in_the_metadata_leaves_the_naming_rule_to_the_others() -> None:
    tracks = [f"prev_track{i}" for i in range(15)]
    result = pairs(
        " ".join(["img", "prev_bev", *tracks]),
        " ".join(["bev_embed", *(f"{name}_out" for name in tracks)]),
        '{"prev_bev": "bev_embed"}',
    )
    named = {name: f"{name}_out" for name in tracks}
    assert result == {"prev_bev": "bev_embed", **named}


@pytest.mark.parametrize(
    ("inputs", "outputs", "metadata", "result"),
    [
        ("img prev_bev", "plan next_bev", None, {"prev_bev": "next_bev"}),
        ("prev_bev", "next_bev prev_bev_out", None, {"prev_bev": "prev_bev_out"}),
        ("a b", "a_out b_out", '{"a": null}', {"b": "b_out"}),
        ("a b", "b_out", '{"a": "b_out"}', {"a": "b_out"}),  # an output answers once
    ],
)
def test_names_and_metadata_say_what_is_fed_back(
    inputs: str, outputs: str, metadata: str | None, result: dict[str, str]
) -> None:
    assert pairs(inputs, outputs, metadata) == result


def test_ports_that_do_not_fit_are_named_with_what_they_are() -> None:
    with pytest.raises(GraphError, match=r"output b is tensor\(bool\) of rank"):
        recurrence({"me2e.recurrent": '{"a": "b"}'}, {"a": STATE}, {"b": FLAG})


@pytest.mark.parametrize(
    ("name", "outputs", "why"),
    [
        ("prev_a", {}, "no output is called prev_a_out or next_a, and the metadata"),
        ("a", {"a_out": FLAG}, "output a_out is tensor.bool. of rank 1, input a"),
        ("a", {"a_out": STATE}, "a_out is not fed back to it: the metadata"),
        ("img", {"plan": STATE}, "^$"),
    ],
)
def test_why_an_input_is_no_state(
    name: str, outputs: dict[str, SessionPort], why: str
) -> None:
    assert re.search(why, not_fed_back(name, {name: STATE}, outputs))


def test_a_missing_state_is_an_error_that_says_why() -> None:
    model = conv_attention()
    model.metadata_props["me2e.recurrent"] = "{}"
    with pytest.raises(FramesError, match=r"memory is missing.*memory_out is not"):
        Session(model).run({"image": np.zeros((1, 3, 8, 8), np.float32)})
