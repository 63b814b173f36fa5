import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.agents.agent_options import (
    AgentOptions,
    conf_parts,
    route_folder,
)
from me2e_compress.agents.graph_agent import GraphAgentOptions
from me2e_compress.agents.real_time import RealTimeOptions
from me2e_compress.errors import EvaluationError
from tests.agents.small_leaderboard import written
from tests.profiles import scaled

KINDS: list[type[AgentOptions]] = [RealTimeOptions, GraphAgentOptions]
KEYS = [*RealTimeOptions.model_fields, *GraphAgentOptions.model_fields, "pid.aim_m"]
VALUES = [
    '"a"',
    '""',
    "1",
    "-1",
    "nan",
    "inf",
    "1e400",
    "true",
    "[]",
    "{x = 1}",
    "1979-05-27",
]


def refusal(kind: type[AgentOptions], path: Path) -> str | None:
    """Return the message where options are refused."""
    try:
        kind.load(path)
    except EvaluationError as error:
        return str(error)
    return None


@given(
    st.sampled_from(KINDS),
    st.dictionaries(st.sampled_from(KEYS), st.sampled_from(VALUES), max_size=5),
    st.one_of(st.just(""), st.text(max_size=20)),
)
@settings(max_examples=scaled(60))
def test_options_are_read_or_refused_in_one_line(
    kind: type[AgentOptions], table: dict[str, str], end: str
) -> None:
    text = "\n".join([f"{key} = {value}" for key, value in table.items()] + [end])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "agent.toml"
        path.write_bytes(text.encode(errors="surrogatepass"))
        words = refusal(kind, path)

    assert words is None or (str(path) in words and "\n" not in words)


@pytest.mark.parametrize("value", ["nan", "inf", "-1.0"])
def test_a_gain_must_be_a_number_and_a_limit_in_range(
    tmp_path: Path, value: str
) -> None:
    text = f'model = "m.onnx"\npid.max_throttle = {value}'

    with pytest.raises(EvaluationError, match=r"pid.max_throttle"):
        GraphAgentOptions.load(written(tmp_path / "g.toml", text))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("a.toml", ("a.toml", "")),
        ("a.toml+Route_1", ("a.toml", "Route_1")),
        ("a.toml+Route_1+Route_2+Route_3", ("a.toml", "Route_3")),
        ("vad.py+vad.pth+Route_1", ("vad.py", "Route_1")),
    ],
)
def test_the_last_field_names_the_route(text: str, parts: tuple[str, str]) -> None:
    path, name = conf_parts(text)

    assert (str(path), name) == parts


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    written(tmp_path / "file", "")

    with pytest.raises(EvaluationError, match=r"file/Route_1: cannot be made"):
        route_folder(tmp_path / "file", "Route_1")
