import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress import evaluate, score
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.evaluators import EVALUATORS
from me2e_compress.metrics.episode import Episode
from me2e_compress.registry import registry
from me2e_compress.shipped.drivers import shipped
from me2e_compress.workflows.evaluate import EvaluateOptions
from me2e_compress.workflows.other_evaluators import evaluator_named, kept
from tests.evaluators.bench2drive.files import checkpoint, record, write
from tests.metrics.drives import drive


@dataclass(frozen=True)
class Lanes:
    """Drives lanes.

    Attributes:
        policy: Who drives.
        routes: How many lanes.
        named: What each is called.
    """

    name: ClassVar[str] = "lanes"
    policy: str
    routes: int = 2
    named: str = "lane"

    def episodes(self) -> Iterator[Episode]:
        for number in range(self.routes):
            name = self.named if self.named != "lane" else f"lane_{number}"
            yield drive(route=name, completion=50.0 + len(self.policy))


@pytest.fixture(autouse=True)
def lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("lanes", f"{__name__}:Lanes", EVALUATORS.group)
    found = {EVALUATORS.group: (entry,)}
    monkeypatch.setattr(registry, "_all_installed", lambda path: found)
    monkeypatch.setattr(EntryPoint, "load", _load)


def _load(entry: EntryPoint) -> object:
    if entry.name == "lanes":
        return Lanes
    module, _, name = entry.value.partition(":")
    return getattr(__import__(module, fromlist=[name]), name)


def options(text: str) -> EvaluateOptions:
    return EvaluateOptions(evaluator=text)


def test_the_policy_is_an_option_and_the_episodes_are_kept(tmp_path: Path) -> None:
    found = evaluate("my.onnx", tmp_path / "r", options("lanes{routes=3}"))

    assert found.scores.routes == found.scores.expected == 3
    assert found.scores.driving_score.value == 57.0
    (scored,) = score(tmp_path / "r").scores.values()
    assert scored == found.scores


def test_a_model_that_ships_goes_by_its_path(tmp_path: Path) -> None:
    found = evaluate("highway", tmp_path / "r", options("lanes"))

    assert found.policy == str(shipped("highway"))


def test_the_same_again_and_another(tmp_path: Path) -> None:
    evaluate("a", tmp_path / "r", options("lanes"))
    evaluate("a", tmp_path / "r", options("lanes"))

    with pytest.raises(EvaluationError, match="holds the results of another"):
        evaluate("b", tmp_path / "r", options("lanes"))


def test_what_was_kept_is_found_again(tmp_path: Path) -> None:
    evaluate("a", tmp_path / "r", options("lanes"))
    same, other = (evaluator_named("lanes", policy) for policy in ("a", "b"))

    assert len(kept(same, tmp_path / "r", "a") or ()) == 2
    assert kept(other, tmp_path / "r", "b") is None
    assert kept(same, tmp_path / "nowhere", "a") is None
    (tmp_path / "r" / "routes" / "lane_1.json").write_text("{")
    assert kept(same, tmp_path / "r", "a") is None


def test_results_of_a_real_run_are_an_evaluator_too(tmp_path: Path) -> None:
    write(tmp_path / "run" / "r.json", checkpoint(record()))

    found = evaluate(
        None, tmp_path / "out", options(f"bench2drive{{folder={tmp_path / 'run'}}}")
    )

    assert (found.scores.routes, found.scores.expected) == (1, 220)
    file = tmp_path / "out" / "routes" / "RouteScenario_1711_rep0.json"
    kept_one = json.loads(file.read_text())["episode"]
    assert kept_one["given"]["status"] == "Completed"


@pytest.mark.parametrize(
    ("policy", "text", "message"),
    [
        ("a", "lanes{speed=3}", "lanes has no option 'speed'"),
        ("a", "lanes{policy=b}", "lanes: option policy is given twice"),
        ("a", "lanes:b", "lanes: option policy is given twice"),
        (None, "lanes", "lanes needs the option policy"),
        ("a", "nobody", "no evaluator 'nobody'; there are highway, bench2drive, lanes"),
        ("a", "lanes{routes=0}", "lanes yields no episode"),
        ("a", "lanes{named=twin}", "lanes yields route twin twice"),
        ("a", 'lanes{named="../x"}', "a name is made of letters"),
        ("a", "bench2drive{folder=.}", "bench2drive drives no policy: leave out a"),
        (None, "highway", "highway drives a policy: name one"),
        ("a", "highway{routes=3}", "highway's options are the command's own"),
    ],
)
def test_wrong_words_are_one_line_and_leave_nothing(
    tmp_path: Path, policy: str | None, text: str, message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        evaluate(policy, tmp_path / "r", options(text))
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("known", "flag"),
    [
        (EvaluateOptions(evaluator="lanes", routes="3"), "--routes"),
        (EvaluateOptions(evaluator="lanes", latency="fps:3"), "--latency"),
        (EvaluateOptions(evaluator="lanes", module_map="m.toml"), "--map"),
        (EvaluateOptions(evaluator="lanes", render="a"), "--render"),
    ],
)
def test_what_highway_alone_understands(
    tmp_path: Path, known: EvaluateOptions, flag: str
) -> None:
    with pytest.raises(EvaluationError, match=f"{flag} is highway's"):
        evaluate("a", tmp_path / "r", known)


def test_a_folder_that_is_read_is_not_written(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(record()))

    with pytest.raises(GraphError, match="is the input"):
        evaluate(None, tmp_path, options(f"bench2drive{{folder={tmp_path}}}"))
