import re
from pathlib import Path

from benchmarks.bench_paper import KEPT, NOTHING, PAGE, page
from me2e_compress.study import load_study
from tests.study.paper_records import write_records


def test_the_page_is_that_of_the_drives_that_are_kept() -> None:
    text = PAGE.read_text("utf-8")

    [asked_at] = re.findall("; questions committed (.*?)\\. All", text)

    assert text == page(KEPT, asked_at)


def test_the_page_of_finished_drives(tmp_path: Path) -> None:
    study = load_study("paper", "5").of_blocks(["3", "6"])
    write_records(study, tmp_path)

    text = page(tmp_path, "")

    assert "not committed" in text.split("**Table 2")[0]
    assert "preview: 5 of 220 routes" in text
    assert "**Table 3: modules away, under device" in text
    assert NOTHING not in text


def test_the_page_before_anything_was_driven(tmp_path: Path) -> None:
    assert page(tmp_path, "").endswith(NOTHING)
