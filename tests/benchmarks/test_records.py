"""What pages and tables say of drives that are kept, held against these drives."""

import csv
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from statistics import mean

import pytest

from benchmarks.measure.intervals import KeptDrive, intra_type_correlation, kept_drives
from benchmarks.measure.road import drives_of, means_of
from benchmarks.paper.drives import KeptFacts
from benchmarks.paper.evidence import NOISE
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_summary import SCATTER
from me2e_compress.study import load_study
from me2e_compress.study.cells import MINUS

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "benchmarks"
ROAD = RECORDS / "road_2"
PAPER, TRIAL = ROAD / "paper", ROAD / "training" / "trial.csv"
PAGES = (
    ROOT / "README.md",
    RECORDS / "README.md",
    ROAD / "training" / "README.md",
    # energy.md has no drives
    *sorted({*(ROOT / "docs").glob("*.md")} - {ROOT / "docs" / "energy.md"}),
)

SIGN = f"[+{MINUS}]"
NUMBER = rf"({SIGN}?\d+\.\d+)"
SIGNED = re.compile(rf"({SIGN}\d+\.\d+) to ({SIGN}\d+\.\d+)")
"""An interval of a difference, with or without its mean."""
INTERVAL = re.compile(
    rf"{NUMBER}(?: points?,| %| success)?\*?\*? \(?(?:95 %: )?{NUMBER} to {NUMBER}"
)
Numbers = tuple[float, ...]


def written(pattern: re.Pattern[str]) -> set[tuple[str, Numbers]]:
    """The numbers of every match of a pattern, with its page."""
    return {
        (page.name, tuple(float(each.replace(MINUS, "-")) for each in match.groups()))
        for page in PAGES
        for match in pattern.finditer(page.read_text("utf-8"))
    }


def rounded(found: Estimate) -> Iterator[Numbers]:
    """The mean with each of its intervals, up and down."""
    value = found.value or 0.0
    for ends in ((found.low, found.high), (found.anew_low, found.anew_high)):
        low, high = (end or 0.0 for end in ends)
        yield round(value, 1), round(low, 1), round(high, 1)
        yield round(-value, 1), round(-high, 1), round(-low, 1)


def paper(name: str) -> KeptDrive:
    """One drive of the paper's."""
    (drive,) = drives_of([PAPER / f"{name}.jsonl"]).values()
    return KeptDrive({name: (own.score, own.success) for name, own in drive.items()})


def compared(drives: dict[str, KeptDrive]) -> Iterator[KeptDrive]:
    """Every drive, and it minus the first scheme, minus the first condition."""
    first, _, free = next(iter(drives)).partition(".")
    for name, drive in drives.items():
        scheme, _, condition = name.partition(".")
        yield drive
        for other in (f"{first}.{condition}", f"{scheme}.{free}"):
            if other in drives and other != name:
                yield drive - drives[other]


def differences() -> Iterator[KeptDrive]:
    """The differences that pages tell."""
    # the paper's questions: int8, spikes, and beyond 24 a second
    for one, other in (
        ("full.fps-10", "exact.fps-10"),
        ("feature-ext.fps-10", "exact.fps-10"),
        ("full-paper.fps-10", "exact.fps-10"),
        ("feature-ext-paper.fps-10", "exact.fps-10"),
        ("optimizer.tail", "optimizer.even"),
        ("optimizer.device-tail", "optimizer.device-even"),
        ("float.fine-30", "float.fine-24"),
    ):
        yield paper(one) - paper(other)
    # one device for all
    for name in ("exact", "feature-ext", "prediction", "full"):
        yield paper(f"{name}.device") - paper("float.device")
    # the trial's routes, and a module away
    yield from compared(kept_drives(TRIAL))
    shipped = kept_drives(ROAD / "trained" / "four" / "routes.csv")["trained.four"]
    without = kept_drives(ROAD / "trained" / "occ" / "routes.csv")
    yield shipped - without["minus-occ.four"]


@cache
def known() -> frozenset[Numbers]:
    """Every mean with its interval that the kept drives give."""
    found = {each for drive in differences() for each in rounded(drive.mean())}
    # driving score, success and room kept
    files = [*ROAD.glob("*/*/routes.csv"), TRIAL]
    files += [PAPER / f"float.{name}.jsonl" for name in ("ideal", "device")]
    for own in (each for path in files for each in drives_of([path]).values()):
        found.update(each for mean in means_of(own).values() for each in rounded(mean))
    return frozenset(found)


def test_every_interval_of_a_page_is_that_of_the_kept_drives() -> None:
    whole, alone = written(INTERVAL), written(SIGNED)
    ends = {each[1:] for each in known()}

    assert len(whole) > 30
    assert sorted(each for each in whole if each[1] not in known()) == []
    assert len(alone) > 10  # of differences, their mean elsewhere
    assert sorted(each for each in alone if each[1] not in ends) == []


def test_the_usual_scatter_is_that_of_the_int8_forms() -> None:
    forms = ("feature-ext", "prediction", "full")
    float_ = paper("float.fps-10")

    scatters = [(paper(f"{name}.fps-10") - float_).scatter for name in forms]

    assert [round(each, 1) for each in scatters] == [23.0, 27.6, 28.0]
    assert round((sum(each**2 for each in scatters) / 3) ** 0.5) == SCATTER


def test_two_runs_of_one_file_differ_by_the_noise_that_is_reckoned_with() -> None:
    facts = KeptFacts.load(PAPER / "variants.json").by_variant
    one, other = facts["float"], facts["optimizer"]
    assert one.sha256 == other.sha256

    medians = [each.latency_ms(50) or 0.0 for each in (one, other)]

    assert [round(each, 1) for each in medians] == [430.2, 414.6]
    assert round(medians[0] / medians[1] - 1.0, 3) == pytest.approx(NOISE, abs=0.004)


@pytest.mark.parametrize(
    "folder", [each.parent for each in sorted(RECORDS.glob("**/tables.md"))]
)
def test_tables_are_of_the_routes_that_are_kept(folder: Path) -> None:
    found = defaultdict[tuple[str, str], list[float]](list)
    with (folder / "routes.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            drive = (row["scheme"], row["condition"])
            found[drive].append(float(row["driving_score_percent"]))
    text = (folder / "tables.md").read_text("utf-8")
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
    study = load_study(RECORDS / f"{name}.toml", "2")

    assert study.pairs


def test_the_correlation_by_hand() -> None:
    # two of each: between types 2 * var(2, 6) = 16, within 2, (16 - 2) / (16 + 2)
    rows = [("a", 1.0), ("a", 3.0), ("b", 5.0), ("b", 7.0)]

    assert intra_type_correlation(rows) == pytest.approx(7 / 9)
