import re
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.bench_paper import NOTHING, PAGES
from me2e_compress.study import load_study
from tests.study.paper_records import write_records


@pytest.mark.parametrize("road", PAGES)
def test_the_page_is_that_of_the_drives_that_are_kept(road: int) -> None:
    page = PAGES[road]
    text = page.path.read_text("utf-8")

    [asked_at] = re.findall("; questions committed (.*?)\\. All", text)

    assert text == page.text(asked_at)


def test_the_page_of_finished_drives(tmp_path: Path) -> None:
    study = load_study("paper", "5").of_blocks(["3", "6"])
    write_records(study, tmp_path)

    text = PAGES[1].text("", tmp_path)

    assert "not committed" in text.split("**Table 2")[0]
    assert "preview: 5 of 220 routes" in text
    assert "**Table 3: modules away, under device" in text
    assert NOTHING not in text


def test_the_page_before_anything_was_driven(tmp_path: Path) -> None:
    assert PAGES[1].text("", tmp_path).endswith(NOTHING)


def test_drives_that_are_kept_make_the_same_tables(tmp_path: Path) -> None:
    records, kept = tmp_path / "run" / "records", tmp_path / "kept"
    write_records(load_study("paper", "5").of_blocks(["6"]), records)
    text = PAGES[1].text("", records)
    names = {path.name for path in records.iterdir()}
    (records / "of.another-study.jsonl").touch()

    replace(PAGES[1], kept=kept).keep(records)

    assert {path.name for path in kept.iterdir()} == {*names, "traces"}
    assert PAGES[1].text("", kept) == text
