import codecs
import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError
from me2e_compress.evaluators.bench2drive.real_results import (
    Bench2DriveResults,
    CollectedResults,
)
from me2e_compress.metrics.episode import InferenceRecord
from me2e_compress.testing import check_evaluator
from tests.evaluators.bench2drive.files import (
    GOOD,
    RAMMED,
    Json,
    checkpoint,
    collect,
    merged,
    record,
    recording,
    write,
)
from tests.support.profiles import scaled

OTHER = record(2082, "Accident", score=(60.0, 1.0, 60.0), status="Failed - TickRuntime")
CRASHED = record(2084, status="Failed - Simulation crashed", score=(0, 1.0, 0))


def routes(result: CollectedResults) -> list[str]:
    return [episode.route.split("_")[1] for episode in result.episodes]


def test_results_files_have_any_name(tmp_path: Path) -> None:
    write(tmp_path / "a" / "eval.json", checkpoint(OTHER))
    write(tmp_path / "gpu1.json", checkpoint(GOOD, CRASHED))
    write(tmp_path / "meta" / "0001.json", {"speed": 3.0})
    (tmp_path / "log.txt").write_text("Traceback (most recent call last):")

    result = collect(tmp_path)

    assert routes(result) == ["1711", "2082", "2084"]
    assert result.route_set == "0.0.3"
    assert result.crashed == ["RouteScenario_2084_rep0"]
    assert len(result.missing) == 217
    assert result.missing[0] == "1773"


def test_a_file_in_utf_16_is_named(tmp_path: Path) -> None:
    write(tmp_path / "good.json", checkpoint(GOOD))
    other = tmp_path / "other.json"
    other.write_text(json.dumps(checkpoint(OTHER)), "utf-16")

    result = collect(tmp_path)

    assert routes(result) == ["1711"]
    assert result.broken.keys() == {str(other)}
    assert result.broken[str(other)].startswith("not JSON: ")


def test_a_file_that_is_too_large_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "large.json"
    write(file, checkpoint(GOOD))
    monkeypatch.setattr(documents, "LARGEST_BYTES", 400)
    monkeypatch.setattr(documents.read_bytes, "__defaults__", (400,))
    with pytest.raises(EvaluationError, match=r"large\.json: not JSON: .* too many"):
        collect(tmp_path)


def test_links_to_folders_are_followed_but_not_in_circles(tmp_path: Path) -> None:
    write(tmp_path / "elsewhere" / "r.json", checkpoint(GOOD))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "back").symlink_to(tmp_path / "run")

    result = collect(tmp_path / "run")

    assert (routes(result), result.repeated) == (["1711"], [])


def test_the_evaluator_keeps_its_promises(tmp_path: Path) -> None:
    write(tmp_path / "merged.json", merged(OTHER, GOOD))
    write(tmp_path / "metrics" / GOOD["save_name"] / "metric_info.json", recording(372))

    first, second = check_evaluator(Bench2DriveResults(tmp_path))

    assert (len(first.frames), len(second.frames)) == (372, 0)


def test_the_same_result_once_more_counts_once(tmp_path: Path) -> None:
    again = {**GOOD, "save_name": "RouteScenario_1711_rep0_later"}
    write(tmp_path / "0.json", checkpoint({**GOOD, "index": 7}))
    write(tmp_path / "1.json", checkpoint(OTHER))
    write(tmp_path / "2.json", checkpoint(again))
    write(tmp_path / "all.json", merged(GOOD, OTHER))

    result = collect(tmp_path)

    assert routes(result) == ["1711", "2082"]
    assert len(result.repeated) == 2
    assert result.contradictory == []


def test_the_worst_of_contradictory_drives_counts(tmp_path: Path) -> None:
    rammed = record(score=(100, 0.6, 60.0), collisions_vehicle=[RAMMED], duration_s=19)
    write(tmp_path / "first.json", checkpoint(GOOD))
    write(tmp_path / "second.json", checkpoint(rammed))

    result = collect(tmp_path)

    assert result.contradictory == ["RouteScenario_1711_rep0"]
    (episode,) = result.episodes
    assert episode.given is not None
    assert episode.given.composed_percent == 60.0


def test_a_crash_gives_way_to_the_drive_that_followed(tmp_path: Path) -> None:
    crashed = record(status="Failed - Agent crashed", score=(3.0, 1.0, 3.0))
    write(tmp_path / "first.json", checkpoint(crashed))
    write(tmp_path / "second.json", checkpoint(GOOD))

    result = collect(tmp_path)

    assert result.rerun == ["RouteScenario_1711_rep0"]
    assert (result.contradictory, result.crashed) == ([], [])
    assert result.episodes[0].succeeded


def test_repetitions_are_other_drives(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD, record(rep=1)))

    result = collect(tmp_path)

    assert len(result.episodes) == result.repetitions == 2
    assert result.repeated == result.contradictory == []


def test_sets_are_told_apart(tmp_path: Path) -> None:
    write(tmp_path / "a" / "r.json", checkpoint(GOOD, OTHER, record(469, weather=None)))
    write(tmp_path / "b" / "r.json", checkpoint(record(5)))

    mixed, unknown = collect(tmp_path / "a"), collect(tmp_path / "b")

    assert mixed.route_set == "0.0.3"
    assert mixed.foreign == ["RouteScenario_469_rep0"]
    assert (unknown.route_set, unknown.missing) == (None, [])


def test_what_is_broken_is_named_and_the_rest_read(tmp_path: Path) -> None:
    half = json.dumps(checkpoint(record(2086)))
    (tmp_path / "half.json").write_text(half[: len(half) // 2])
    begun = {"route_id": "RouteScenario_2091_rep0", "status": "Started"}
    score: Json = {"score_route": 0, "score_penalty": 0, "score_composed": float("nan")}
    scored = {**record(2115), "scores": score}
    write(tmp_path / "r.json", checkpoint(GOOD, begun, scored))
    write(tmp_path / "killed.json", checkpoint())

    result = collect(tmp_path)

    assert routes(result) == ["1711"]
    reasons = list(result.broken.values())
    assert reasons[0].startswith("not JSON: ")
    assert reasons[1] == "infractions: Field required"
    assert reasons[2].startswith("scores.score_composed: Input should be")
    assert list(result.broken)[1] == f"{tmp_path / 'r.json'}, record 1"
    assert result.unfinished == [tmp_path / "killed.json"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "no whole record of a leaderboard below it$"),
        ("", r"below it: .*r\.json: not JSON"),
        ('{ "_check', r"below it: .*r\.json: not JSON"),
        ('{"_checkpoint": {"rec', r"below it: .*r\.json: not JSON"),
        ('{"_checkpoint": 5}', r"r\.json: _checkpoint: Input should be"),
        ('{"_checkpoint": {"records": []}}', "no whole record of a leaderboard"),
        ('{"_checkpoint": {"records": [7]}}', r"r\.json, record 0: record: Input"),
    ],
)
def test_a_folder_of_nothing(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "r.json").write_text(content)

    with pytest.raises(EvaluationError, match=message):
        collect(tmp_path)
    with pytest.raises(EvaluationError, match="no such folder"):
        collect(tmp_path / "nowhere")


FILES = {
    "r.json": json.dumps(checkpoint(GOOD, OTHER)),
    f"{GOOD['save_name']}/metric_info.json": json.dumps(recording(3)),
}


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=scaled(60)
)
@given(
    st.sampled_from(list(FILES)),
    st.floats(0.0, 1.0),
    st.sampled_from(["cut", "1e999", "NaN", "null", "[]", "{}", '"', "\x00", "-"]),
)
def test_whatever_became_of_a_file(
    tmp_path: Path, name: str, share: float, change: str
) -> None:
    for file, text in FILES.items():
        at = int(share * len(text))
        if file == name:
            text = text[:at] + ("" if change == "cut" else change + text[at + 1 :])
        path = tmp_path / file
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)

    try:
        result = collect(tmp_path)
    except EvaluationError:
        return
    assert len(result.episodes) <= 2


# Which recordings and logs of decisions lie beside results, and of which drive.


@pytest.mark.parametrize(
    "where",
    [
        f"{GOOD['save_name']}/metric_info.json",
        f"deep/bench2drive220_{GOOD['save_name']}/metric_info.json",
        f"{GOOD['save_name']}/saved/metric_info.json",
        "metric_info.json",  # beside the only record of the folder
    ],
)
def test_recordings_are_found_by_the_name_of_the_drive(
    tmp_path: Path, where: str
) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    write(tmp_path / where, recording(40))

    result = collect(tmp_path)

    assert len(result.episodes[0].frames) == 40
    assert result.unrecorded == []


NAME = str(GOOD["save_name"])
INFO = "metric_info.json"
STEPS = recording(30)


@pytest.mark.parametrize(
    ("beside", "frames", "named", "note"),
    [
        ({f"{NAME.replace('_36', '_11')}/{INFO}": STEPS}, 0, 0, "of no record"),
        ({"saved/7/metric_info.json": STEPS}, 0, 0, "of no record"),
        (
            {f"a/{NAME}/{INFO}": STEPS, f"b/{NAME}/{INFO}": recording(40)},
            *(30, 0, "one of 2 of the same drive"),
        ),
        (
            {f"a/{NAME}/{INFO}": {}, f"b/{NAME}/{INFO}": STEPS},
            *(30, 1, "one of 2 of the same drive"),  # the other is broken
        ),
        (
            {f"{NAME}/{INFO}": {step: STEPS[step] for step in sorted(STEPS)}},
            *(30, 0, "steps out of order: comfort is of no drive"),
        ),
    ],
)
def test_which_of_the_recordings_is_taken_and_what_is_said_of_it(
    tmp_path: Path, beside: dict[str, Json], frames: int, named: int, note: str
) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    files = [write(tmp_path / name, steps) for name, steps in beside.items()]

    result = collect(tmp_path)

    assert len(result.episodes[0].frames) == frames
    assert bool(result.unrecorded) == (frames == 0)
    assert result.notes == [f"{files[named]}: {note}"]


@pytest.mark.parametrize(
    "content", ["cut off", {}, [], {"0": None}, {"note": 1, **recording(3)}]
)
def test_a_metric_info_that_is_no_recording_is_named(
    tmp_path: Path, content: object
) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    file = write(tmp_path / GOOD["save_name"] / "metric_info.json", content)

    result = collect(tmp_path)

    assert list(result.broken) == [str(file)]
    assert result.episodes[0].frames == ()


def test_decisions_may_be_noted_in_another_folder(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    write(tmp_path / "saved" / GOOD["save_name"] / "metric_info.json", recording(40))
    noted = {"frame": 3, "latency_us": 90_000}
    log = write(tmp_path / "logs" / GOOD["save_name"] / "decisions.jsonl", noted)
    log.write_text(json.dumps(noted))

    (episode,) = collect(tmp_path).episodes

    assert episode.decisions == (InferenceRecord(150_000, 90_000),)


def test_a_log_of_decisions_that_is_cut_off_is_named(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    write(tmp_path / GOOD["save_name"] / "metric_info.json", recording(40))
    log = tmp_path / GOOD["save_name"] / "decisions.jsonl"
    log.write_text('{"frame": 0, "latency_us": 90000}\n{"frame": 1, "late')

    assert collect(tmp_path).broken == {str(log): "line 2 is no decision"}


def test_a_byte_order_mark_hides_nothing(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    write(tmp_path / GOOD["save_name"] / "metric_info.json", recording(40))
    for file in tmp_path.rglob("*.json"):
        file.write_bytes(codecs.BOM_UTF8 + file.read_bytes())

    assert len(collect(tmp_path).episodes[0].frames) == 40


def test_recordings_in_both_folders_are_one_and_may_lie_apart(tmp_path: Path) -> None:
    results, saved = tmp_path / "results", tmp_path / "saved"
    for folder in (results, saved):
        write(folder / "r.json", checkpoint(GOOD))
    write(saved / NAME / "metric_info.json", recording(25, 0.5, every=10))

    for place in (saved, results):
        result = Bench2DriveResults(place, saved).collect()
        assert len(result.episodes[0].frames) == 25
        assert result.off_rate == {"RouteScenario_1711_rep0": 0.5}
