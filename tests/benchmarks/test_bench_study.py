import csv
import re
from collections import defaultdict
from pathlib import Path
from statistics import mean

import pytest

from me2e_compress.study import load_study

KEPT = Path(__file__).parents[2] / "benchmarks"
STUDIES = sorted(
    str(each.parent.relative_to(KEPT)) for each in KEPT.glob("**/tables.md")
)


@pytest.mark.parametrize("name", STUDIES)
def test_tables_are_of_the_routes_that_are_kept(name: str) -> None:
    found = defaultdict[tuple[str, str], list[float]](list)
    with (KEPT / name / "routes.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            drive = (row["scheme"], row["condition"])
            found[drive].append(float(row["driving_score_percent"]))
    text = (KEPT / name / "tables.md").read_text("utf-8")
    # a board of one condition has a row a variant, one of one variant a row a condition
    boards = re.findall(r"\*\*Scoreboard(, | of )([\w-]+).*\n\n((?:\|.*\n)+)", text)
    scores = {}
    for kind, named, table in boards:
        for line in table.splitlines()[2:]:
            row = line.split(" ")
            drive = (row[1], named) if kind == ", " else (named, row[1])
            scores[drive] = float(row[3])

    assert {len(each) for each in found.values()} == {220}
    assert {drive: round(mean(each), 1) for drive, each in found.items()} == scores


@pytest.mark.parametrize("name", ["tail", "shifts"])
def test_a_study_of_the_repository_is_whole(name: str) -> None:
    study = load_study(KEPT / f"{name}.toml", "2")

    assert study.pairs or any(each.against for each in study.conditions)
