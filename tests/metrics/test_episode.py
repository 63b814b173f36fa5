import json
import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.metrics.episode import (
    LARGEST,
    ConflictRecord,
    Contact,
    EgoFrame,
    Encounter,
    Ending,
    Episode,
    Given,
    InferenceRecord,
    Infraction,
    InfractionKind,
)
from tests.metrics.drives import cruise, drive, infraction
from tests.support.profiles import scaled

numbers = st.floats(-LARGEST, LARGEST)
percents = st.floats(0.0, 100.0)
lengths = st.floats(0.0, LARGEST)
times = st.integers(0, 10**10)
frame_rows = st.builds(
    EgoFrame,
    times,
    *[numbers] * 9,
    traffic_speed_mps=st.none() | numbers,
    acceleration_norm_mps2=st.none() | numbers,
)
infractions = st.builds(
    Infraction,
    *(st.sampled_from(InfractionKind), times, numbers, numbers, st.text(max_size=8)),
    *(st.none() | percents, st.none() | st.sampled_from(Contact)),
    *(st.none() | st.booleans(), st.none() | lengths),
)
encounters = st.builds(
    Encounter,
    *(st.integers(0, 99), st.text(max_size=4), times, lengths),
    *(st.floats(0.0, math.pi), st.booleans()),
)
episodes = st.builds(
    Episode,
    *(st.text(max_size=8), st.text(max_size=8)),
    st.lists(st.text(max_size=4), max_size=2).map(tuple),
    *(lengths, percents, st.sampled_from(Ending), st.none() | st.text(max_size=8)),
    st.lists(infractions, max_size=2).map(tuple),
    st.lists(frame_rows, max_size=4).map(tuple),
    st.lists(st.builds(InferenceRecord, times, times), max_size=3).map(tuple),
    st.none() | numbers,
    st.none() | st.lists(numbers, max_size=3).map(tuple),
    st.none() | st.builds(Given, st.text(max_size=8), numbers, numbers, numbers),
    st.none()
    | st.builds(
        ConflictRecord,
        *[st.lists(st.none() | lengths, max_size=3).map(tuple)] * 2,
        st.lists(encounters, max_size=2).map(tuple),
    ),
)


@settings(max_examples=scaled(40))
@given(episodes)
def test_json_brings_back_every_bit(episode: Episode) -> None:
    text = json.dumps(episode.to_json(), allow_nan=False)

    assert Episode.from_json(json.loads(text)) == episode


def test_a_file_of_an_earlier_version_is_read() -> None:
    record = drive().to_json()
    del record["given"], record["conflicts"]

    assert Episode.from_json(record) == drive()


SPOILED: dict[str, Callable[[dict[str, Any]], object]] = {
    "a field is missing": lambda record: record.pop("scenario"),
    "a field is unknown": lambda record: record.update(weather="fog"),
    "not a number": lambda record: record["frames"]["x"].__setitem__(0, math.nan),
    "a column is short": lambda record: record["frames"]["x"].pop(),
    "rows for columns": lambda record: record.update(decisions=[[0, 0]]),
    "an unknown ending": lambda record: record.update(ending="fell asleep"),
}


@pytest.mark.parametrize("how", SPOILED)
def test_a_spoiled_record_is_refused(how: str) -> None:
    record = drive(infraction(InfractionKind.STOP), driven=cruise()).to_json()
    SPOILED[how](record)

    with pytest.raises(ValueError, match=r".+"):
        Episode.from_json(record)
