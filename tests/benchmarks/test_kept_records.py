"""What pages say of drives that are kept, held against these drives."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from benchmarks.bench_intervals import KeptDrive, kept_drives
from benchmarks.bench_road import drives_of, means_of
from benchmarks.paper.drives import KeptFacts
from benchmarks.paper.evidence import NOISE
from me2e_compress.metrics.differences import SCATTER
from me2e_compress.metrics.measure import Estimate
from me2e_compress.study.cells import MINUS

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "benchmarks"
PAGES = (
    ROOT / "README.md",
    RECORDS / "README.md",
    RECORDS / "road_2" / "training" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
)
PAPER_2 = RECORDS / "road_2" / "paper"
TRIAL = RECORDS / "road_2" / "training" / "trial.csv"
ELSEWHERE = ("energy.md",)
"""It has no drives."""

SIGN = f"[+{MINUS}]"
NUMBER = rf"({SIGN}?\d+\.\d+)"
SIGNED = re.compile(rf"({SIGN}\d+\.\d+) to ({SIGN}\d+\.\d+)")
"""An interval of a difference, with or without its mean."""
INTERVAL = re.compile(
    rf"{NUMBER}(?: points?,| %| success)?\*?\*? \(?(?:95 %: )?{NUMBER} to {NUMBER}"
)
Triple = tuple[float, float, float]
NOT_KEPT: dict[Triple, str] = {}


def number(text: str) -> float:
    return float(text.replace(MINUS, "-"))


def intervals(page: Path) -> Iterator[Triple]:
    """The means of a page that stand with an interval."""
    for found in INTERVAL.finditer(page.read_text("utf-8")):
        value, low, high = map(number, found.groups())
        yield value, low, high


def rounded(found: Estimate) -> Iterator[Triple]:
    """The mean with each of its intervals, up and down."""
    value = found.value or 0.0
    for ends in ((found.low, found.high), (found.anew_low, found.anew_high)):
        low, high = (end or 0.0 for end in ends)
        yield round(value, 1), round(low, 1), round(high, 1)
        yield round(-value, 1), round(-high, 1), round(-low, 1)


def only(path: Path) -> KeptDrive:
    """The one drive of a file."""
    (drive,) = drives_of([path]).values()
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


def asked() -> Iterator[KeptDrive]:
    """The differences that pages tell besides."""
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
        own, beside = (PAPER_2 / f"{name}.jsonl" for name in (one, other))
        yield only(own) - only(beside)
    # one device for all
    float_ = only(PAPER_2 / "float.device.jsonl")
    for name in ("exact", "feature-ext", "prediction", "full"):
        yield only(PAPER_2 / f"{name}.device.jsonl") - float_
    # the trial's routes, and a module away
    yield from compared(kept_drives(TRIAL))
    trained = RECORDS / "road_2" / "trained"
    shipped = kept_drives(trained / "four" / "routes.csv")["trained.four"]
    yield shipped - kept_drives(trained / "occ" / "routes.csv")["minus-occ.four"]


@cache
def known() -> frozenset[Triple]:
    """Every mean with its interval that the kept drives give."""
    found = set[Triple]()
    for drive in asked():
        found.update(rounded(drive.mean()))
    # driving score, success and room kept
    files = [*(RECORDS / "road_2").glob("*/*/routes.csv"), TRIAL]
    files += [PAPER_2 / f"float.{name}.jsonl" for name in ("ideal", "device")]
    for own in (each for path in files for each in drives_of([path]).values()):
        for mean in means_of(own).values():
            found.update(rounded(mean))
    return frozenset(found)


def test_every_interval_of_a_page_is_that_of_the_kept_drives() -> None:
    pages = [each for each in PAGES if each.name not in ELSEWHERE]
    told = {(page.name, each) for page in pages for each in intervals(page)}

    lost = sorted(e for e in told if e[1] not in known())

    assert len(told) > 30
    assert not lost


def test_so_are_those_of_differences_that_stand_alone() -> None:
    ends = {each[1:] for each in known()}
    pages = [each for each in PAGES if each.name not in ELSEWHERE]
    told = {
        (page.name, tuple(map(number, found)))
        for page in pages
        for found in SIGNED.findall(page.read_text("utf-8"))
    }

    assert len(told) > 10
    assert not sorted(each for each in told if each[1] not in ends)


def test_an_interval_that_the_drives_do_not_give_is_seen() -> None:
    assert (74.6, 70.6, 78.4) not in known()
    assert (74.6, 70.7, 78.4) in known()
    assert (74.6, 68.8, 80.2) in known()


def test_the_usual_scatter_is_that_of_the_int8_forms() -> None:
    forms = ("feature-ext", "prediction", "full")
    float_ = only(PAPER_2 / "float.fps-10.jsonl")

    scatters = [(only(PAPER_2 / f"{n}.fps-10.jsonl") - float_).scatter for n in forms]

    assert [round(each, 1) for each in scatters] == [23.0, 27.6, 28.0]
    assert round((sum(each**2 for each in scatters) / 3) ** 0.5) == SCATTER


def test_two_runs_of_one_file_differ_by_the_noise_that_is_reckoned_with() -> None:
    facts = KeptFacts.load(PAPER_2 / "variants.json").by_variant
    one, other = facts["float"], facts["optimizer"]
    assert one.sha256 == other.sha256

    medians = [each.latency_ms(50) or 0.0 for each in (one, other)]

    assert [round(each, 1) for each in medians] == [430.2, 414.6]
    assert round(medians[0] / medians[1] - 1.0, 3) == pytest.approx(NOISE, abs=0.004)
