"""Which recordings and logs of decisions lie beside results, and of which drive."""

import codecs
import json
from pathlib import Path

import pytest

from me2e_compress.evaluators.bench2drive.real_results import Bench2DriveResults
from me2e_compress.metrics.episode import InferenceRecord
from tests.evaluators.bench2drive.files import (
    GOOD,
    checkpoint,
    collect,
    recording,
    write,
)


@pytest.mark.parametrize(
    "where",
    [
        f"{GOOD['save_name']}/metric_info.json",
        f"deep/bench2drive220_{GOOD['save_name']}/metric_info.json",
        f"{GOOD['save_name']}/saved/metric_info.json",
        f"{GOOD['save_name']}.json",
        "metric_info.json",  # beside the only record of the folder
    ],
)
def test_recordings_are_found_by_the_name_of_the_drive(
    tmp_path: Path, where: str
) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    write(tmp_path / where, recording(40))

    found = collect(tmp_path)

    assert len(found.episodes[0].frames) == 40
    assert found.unrecorded == []


def test_the_recording_of_another_drive_is_not_taken(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    earlier = GOOD["save_name"].replace("_36", "_11")
    write(tmp_path / earlier / "metric_info.json", recording())

    assert collect(tmp_path).unrecorded == ["RouteScenario_1711_rep0"]


def test_a_recording_of_no_record_is_named(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    stray = write(tmp_path / "saved" / "7" / "metric_info.json", recording())

    assert collect(tmp_path).notes == [f"{stray}: of no record"]


def test_of_two_recordings_one_counts_and_is_named(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    first = write(tmp_path / "a" / GOOD["save_name"] / "m.json", recording(30))
    write(tmp_path / "b" / GOOD["save_name"] / "m.json", recording(40))

    assert collect(tmp_path).notes == [f"{first}: one of 2 of the same drive"]


def test_a_whole_recording_stands_in_for_a_broken_one(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    write(tmp_path / "a" / GOOD["save_name"] / "metric_info.json", {})
    write(tmp_path / "b" / GOOD["save_name"] / "metric_info.json", recording(40))

    assert len(collect(tmp_path).episodes[0].frames) == 40


@pytest.mark.parametrize(
    "content", ["cut off", {}, [], {"0": None}, {"note": 1, **recording(3)}]
)
def test_a_metric_info_that_is_no_recording_is_named(
    tmp_path: Path, content: object
) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    file = write(tmp_path / GOOD["save_name"] / "metric_info.json", content)

    found = collect(tmp_path)

    assert list(found.broken) == [str(file)]
    assert found.episodes[0].frames == ()


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


def test_steps_out_of_order_are_named(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    steps = recording(30)
    as_text = {step: steps[step] for step in sorted(steps)}
    file = write(tmp_path / GOOD["save_name"] / "metric_info.json", as_text)

    assert collect(tmp_path).notes == [
        f"{file}: steps out of order: comfort is of no drive",
    ]


def test_a_byte_order_mark_hides_nothing(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    write(tmp_path / GOOD["save_name"] / "m.json", recording(40))
    for file in tmp_path.rglob("*.json"):
        file.write_bytes(codecs.BOM_UTF8 + file.read_bytes())

    assert len(collect(tmp_path).episodes[0].frames) == 40


def test_recordings_in_both_folders_are_one(tmp_path: Path) -> None:
    write(tmp_path / "r.json", checkpoint(GOOD))
    write(tmp_path / "metric_info.json", recording(25))

    found = Bench2DriveResults(tmp_path, tmp_path).collect()

    assert len(found.episodes[0].frames) == 25


def test_recordings_may_lie_apart(tmp_path: Path) -> None:
    write(tmp_path / "results" / "r.json", checkpoint(GOOD))
    write(tmp_path / "saved" / GOOD["save_name"] / "m.json", recording(25, 0.5))

    found = Bench2DriveResults(tmp_path / "results", tmp_path / "saved").collect()

    assert len(found.episodes[0].frames) == 25
    assert found.off_rate == {"RouteScenario_1711_rep0": 0.5}
