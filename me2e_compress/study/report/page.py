"""A report as one self-contained HTML page, built from a template."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from me2e_compress.base import atomic
from me2e_compress.base.atomic import MARK, write_bytes, write_document
from me2e_compress.base.display import Table, escape_markdown, plural
from me2e_compress.base.errors import StudyError
from me2e_compress.commands.checks import writing
from me2e_compress.metrics.route_summary import smallest_difference
from me2e_compress.study.cells import estimate_cell
from me2e_compress.study.report.figures import MOST_DRIVES, answer, differences, road
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN


@dataclass(frozen=True)
class Drawing:
    """A picture with a note below it."""

    picture: Markup
    note: str = ""


@dataclass(frozen=True)
class Section:
    """A heading with pictures; tables are folded, and pictures if they are ``high``."""

    title: str
    tables: tuple[Table, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    high: bool = False


@dataclass(frozen=True)
class Page:
    """All that a page shows: the answer first, the details folded."""

    title: str
    lede: str
    sections: Sequence[Section]
    made: Sequence[tuple[str, str]]  # how it was made, by name
    # Name of each variant, what it was made of, and its sha256
    variants: Sequence[tuple[str, str, str | None]]
    # What a reader should remember: a name and a sentence
    findings: Sequence[tuple[str, str]] = ()
    findings_note: str = ""
    alerts: Sequence[str] = ()
    answer: Drawing | None = None  # the picture that stands before everything else

    def html(self) -> str:
        """Write it as HTML that needs no other file."""
        templates = Environment(
            loader=FileSystemLoader(Path(__file__).parent),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        return templates.get_template("page.html").render(page=self, mark=MARK)


TIMES = "\N{MULTIPLICATION SIGN}"


def study_page(outcome: StudyResult, command: Sequence[str] = ()) -> Page:
    """Return the page of a comparison, with the command that made it."""
    # What the variants were made of
    variants = list[tuple[str, str, str | None]]()
    for prepared in outcome.variants:
        made_of = prepared.source or prepared.variant.policy
        if prepared.pipeline:
            made_of = f"{made_of} → {prepared.pipeline}"
        if prepared.weights:
            made_of = f"{made_of}; weights: {prepared.weights}"
        variants.append((prepared.variant.name, made_of, prepared.sha256))
    # How they were timed
    timing = outcome.study.timing
    load = "" if outcome.load is None else f"; while it was timed, {outcome.load}"
    timed = (
        f"{timing.samples} inferences a model, in turn, on"
        f" {plural(timing.threads, 'thread')}; device scale {outcome.device_scale:.3g}"
    )
    # Which routes they drove, under which conditions
    study, (driven, whole) = outcome.study, outcome.coverage
    share = "" if driven == whole else f"{driven} of "
    described = "; ".join(map(outcome.described, study.conditions))
    lede = (
        f"Drivers compared in closed loop on the same {share}{plural(whole, 'route')}"
        f" of {study.driven_by.label}. {described}."
    )
    # How bars, dots and lines of the answer are read
    frames = max(variant.fidelity.frames for variant in outcome.variants)
    notes = [f"Black: {study.baseline}, which the others are compared with."]
    if outcome.timed:
        notes.append("Time: median of one inference.")
    if frames:
        notes.append(
            "Plan: how far the planned waypoints are from those of"
            f" {study.baseline}, mean over {plural(frames, 'frame')} (dot) and the"
            " largest distance (end of the line)."
        )
    notes.append(
        f"Driving score: mean over {plural(driven, 'route')} (dot) and its 95 %"
        " interval (line and brackets)."
    )
    if len(outcome.drives) > MOST_DRIVES:
        notes.append(f"Driving scores are those under {study.conditions[0].name}.")
    made = [
        ("Command", " ".join(command)),
        ("Machine", f"{outcome.machine}{load}"),
        ("Latency", timed if outcome.timed else ""),
        ("Versions", ", ".join(f"{k} {text}" for k, text in outcome.versions.items())),
        ("Seed", str(outcome.study.seed)),
    ]
    return Page(
        outcome.title,
        lede,
        _sections(outcome),
        made,
        variants,
        findings(outcome),
        limits(outcome),
        outcome.alerts(),
        Drawing(answer(outcome), " ".join(notes)),
    )


def _sections(outcome: StudyResult) -> list[Section]:
    """Return the sections that have something to show, in reading order."""
    baseline, tables = outcome.study.baseline, dict(outcome.tables_by_section)
    note = (
        "Means over the routes, with their 95 % intervals. Success: the whole route"
        " without an infraction. Room kept: 100 where nobody came near, 0 after a"
        " collision of the driver's own fault."
    )
    drawings = {"On the road": (Drawing(road(outcome), note),)}
    titles = {"Differences": f"Differences to {baseline} on the same routes"}
    # Without a difference there is nothing to compare
    if (gaps := differences(outcome)) is None:
        tables["Differences"] = ()
    else:
        note = (
            f"Each drive minus that of {baseline}, route by route, and the 95 %"
            " interval of the mean. Blue and filled: it does not hold zero. Grey and"
            " empty: no difference is shown."
        )
        drawings["Differences"] = (Drawing(gaps, note),)
    high = len(outcome.drives) > MOST_DRIVES
    return [
        Section(titles.get(name, name), theirs, drawings.get(name, ()), high)
        for name, theirs in tables.items()
        if theirs
    ]


def findings(outcome: StudyResult) -> tuple[tuple[str, str], ...]:
    """Say of every variant but the baseline what it costs and how it drives."""
    several = len(outcome.study.conditions) > 1
    baseline = outcome.variant(outcome.study.baseline)
    # Costs relative to the baseline's, then the difference of every drive
    sentences = list[tuple[str, str]]()
    for variant in outcome.variants:
        if variant is baseline:
            continue
        compared = (
            (variant.size_mb, baseline.size_mb, "the size"),
            (variant.latency_ms[50], baseline.latency_ms[50], "the time of a decision"),
        )
        costs = [
            f"{one.value / other.value:.2f} {TIMES} {what}"
            for one, other, what in compared
            if one.value is not None and other.value
        ]
        parts = [", ".join(costs)]
        for drive in outcome.drives:
            if drive.variant == variant.name and (gap := drive.difference) is not None:
                where = f"{drive.condition}: " if several else ""
                points = estimate_cell(gap.driving_score, signed=True)
                interval = f" ({points.detail})" * bool(points.detail)
                score = f"{points.text} points{interval}"
                parts.append(f"{where}driving score {score}, {gap.verdict}")
        words = "; ".join(filter(None, parts)) or "nothing could be compared"
        sentences.append((variant.name, f"{words}."))
    return tuple(sentences)


def limits(outcome: StudyResult) -> str:
    """Say what differences are, and what so many routes cannot show; or nothing."""
    gaps = [gap for drive in outcome.drives if (gap := drive.difference) is not None]
    if not gaps:
        return ""
    (routes, whole), least = outcome.coverage, max(gap.least_detectable for gap in gaps)
    rest = ""
    if routes < whole:
        rest = f", all {whole} none below {smallest_difference(whole):.1f}"
    note = (
        f"Differences to {outcome.study.baseline} on the same routes, in brackets the"
        f" 95 % interval of the mean. {plural(routes, 'route')} cannot show a"
        f" difference below {least:.1f} points of driving score{rest}."
    )
    free = [one.name for one in outcome.study.conditions if one.latency == "none"]
    if free:
        under = ", ".join(free)
        note += f" Decisions cost no time under {under}: no latency shows there."
    return note


class StudyFiles(NamedTuple):
    """Paths of the JSON record, Markdown tables and HTML report of a study."""

    record: Path
    tables: Path
    report: Path


def write_study(
    outcome: StudyResult,
    folder: str | Path,
    command: Sequence[str] = (),
    *,
    force: bool = False,
) -> StudyFiles:
    """Write JSON, Markdown and HTML, each atomically.

    Args:
        outcome: Results to write.
        folder: Created if needed.
        command: The command line that reproduces the study, word by word.
        force: Also replace files that we did not write.

    Raises:
        StudyError: The folder cannot be written.
        GraphError: A file is there that we did not write.
    """
    # Paths, and all tables as Markdown
    folder = Path(folder)
    written = StudyFiles(folder / JSON, folder / MARKDOWN, folder / HTML)
    heading = f"{atomic.IN_MARKDOWN}# {escape_markdown(outcome.title)}\n\n"
    text = heading + "\n".join(table.markdown() for table in outcome.tables())
    page = study_page(outcome, command)
    # Write all files, or none
    with atomic.writing_errors(folder, StudyError):
        folder.mkdir(parents=True, exist_ok=True)
        with writing(written, force=force), atomic.all_or_none():
            write_document(written.record, outcome.to_json(), indent=1)
            write_bytes(written.tables, text.encode())
            write_bytes(written.report, page.html().encode())
    return written
