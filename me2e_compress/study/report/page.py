"""A report as one self-contained HTML page, built from a template."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from me2e_compress.display import Table, counted, in_markdown
from me2e_compress.errors import StudyError
from me2e_compress.metrics.measure import Estimate
from me2e_compress.registry import drafts
from me2e_compress.registry.drafts import MARK
from me2e_compress.runtime.atomic import write_bytes, write_document
from me2e_compress.study.cells import number
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.report.figures import curves, forest, pareto
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
from me2e_compress.workflows.checks import writing


@dataclass(frozen=True)
class Drawing:
    """A picture with a caption above it, and a note below."""

    picture: Markup
    note: str = ""
    caption: str = ""


@dataclass(frozen=True)
class Section:
    """A heading with pictures, their note, tables, and named files to link."""

    title: str
    tables: tuple[Table, ...] = ()
    files: tuple[tuple[str, str], ...] = ()
    drawings: tuple[Drawing, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Page:
    """All that a page shows.

    Attributes:
        findings: What a reader should remember: a name and a sentence.
        made: How it was made, by name.
        variants: Name of each variant, what it was made of, and its sha256.
    """

    title: str
    lede: str
    sections: Sequence[Section]
    made: Sequence[tuple[str, str]]
    variants: Sequence[tuple[str, str, str | None]]
    findings: Sequence[tuple[str, str]] = ()
    findings_note: str = ""
    alerts: Sequence[str] = ()

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
COSTS = "What a point of driving score costs"


def study_page(
    outcome: StudyResult, command: Sequence[str] = (), sections: Sequence[Section] = ()
) -> Page:
    """Return the page of a comparison; ``sections`` stand before how it was made."""
    # what the variants were made of, and how they were timed
    variants = list[tuple[str, str, str | None]]()
    for prepared in (each.prepared for each in outcome.variants):
        made_of = prepared.source or prepared.variant.policy
        if prepared.pipeline:
            made_of = f"{made_of} → {prepared.pipeline}"
        if prepared.weights:
            made_of = f"{made_of}; {prepared.weights}"
        variants.append((prepared.variant.name, made_of, prepared.sha256))
    timing = outcome.study.timing
    load = "" if outcome.load is None else f"; while it was timed, {outcome.load}"
    timed = (
        f"{timing.samples} inferences a model, in turn, on"
        f" {counted(timing.threads, 'thread')}; device scale {outcome.device_scale:.3g}"
    )
    made = [
        ("Command", " ".join(command)),
        ("Machine", f"{outcome.machine}{load}"),
        ("Latency", timed if outcome.timed else ""),
        ("Versions", ", ".join(f"{k} {text}" for k, text in outcome.versions.items())),
        ("Seed", str(outcome.study.seed)),
    ]
    # what is remembered stands first
    remembered = findings(outcome)
    note = (
        f"Against {outcome.study.baseline}, the same routes; in brackets the 95 %"
        " interval of the mean difference."
    )
    free = [each.name for each in outcome.study.conditions if each.latency == "none"]
    if free:
        note += (
            f" Decisions cost no time under {', '.join(free)}: no latency shows there."
        )
    return Page(
        outcome.title,
        _lede(outcome),
        [*_sections(outcome), *sections],
        made,
        variants,
        remembered,
        note if remembered else "",
        outcome.alerts(),
    )


def _sections(outcome: StudyResult) -> list[Section]:
    """Return the sections that have something to show, in reading order."""
    study, baseline = outcome.study, outcome.study.baseline
    # pictures by the heading that they stand under
    drawings = dict[str, tuple[Drawing, ...]]()
    if (curve := curves(outcome)) is not None:
        note = "Dots are means over routes, bars their 95 % intervals."
        drawings["Scoreboard"] = (Drawing(curve, note),)
    if (gaps := forest(outcome)) is not None:
        note = (
            f"Each dot is the mean difference to {baseline} over the routes, the bar"
            " its 95 % interval; blue where it does not hold zero."
        )
        drawings["Paired differences"] = (Drawing(gaps, note),)
    fronts = {each.name: pareto(outcome, each) for each in study.conditions}
    drawn = {name: front for name, front in fronts.items() if front is not None}
    drawings[COSTS] = tuple(
        Drawing(front, caption=name if len(drawn) > 1 else "")
        for name, front in drawn.items()
    )
    # without a difference there is nothing to compare
    tables = dict(outcome.tables_by_section)
    headings = list(tables)
    headings.insert(headings.index("Route by route"), COSTS)
    if gaps is None:
        tables["Paired differences"] = ()
    notes = {
        COSTS: "The line joins the variants that no other beats on both counts. Bars:"
        f" 95 % intervals of the driving score. Black: {baseline}. Where there are"
        f" many, only the front and {baseline} are named.",
    }
    return [
        Section(
            name,
            tables.get(name, ()),
            drawings=drawings.get(name, ()),
            note=notes.get(name, ""),
        )
        for name in headings
        if tables.get(name) or drawings.get(name)
    ]


def _lede(outcome: StudyResult) -> str:
    # what was driven
    study = outcome.study
    driven, whole = outcome.coverage
    share = f"{driven}" if driven == whole else f"{driven} of {whole}"
    where = f"of {study.driven_by.label}"
    names = ", ".join(each.name for each in study.conditions)
    said = (
        f"{counted(len(study.variants), 'variant')} on {share} routes {where}, "
        f"closed loop; {counted(len(study.conditions), 'condition')}: {names}."
    )
    # what so many routes can show
    found = [each.difference for each in outcome.drives if each.difference is not None]
    if not found:
        return said
    least = max(each.smallest_shown for each in found)
    return (
        f"{said} {counted(driven, 'route')} cannot show a difference below {least:.1f}"
        " points of driving score."
    )


def findings(outcome: StudyResult) -> tuple[tuple[str, str], ...]:
    """Say of every variant but the baseline what it costs and how it drives."""
    several = len(outcome.study.conditions) > 1
    baseline = outcome.variant(outcome.study.baseline)
    sentences = list[tuple[str, str]]()
    for variant in outcome.variants:
        if variant is baseline:
            continue
        compared = (
            (variant.size_mb, baseline.size_mb, "the size"),
            (variant.latency_ms[50], baseline.latency_ms[50], "the median latency"),
        )
        costs = [
            f"{one.value / other.value:.2f} {TIMES} {what}"
            for one, other, what in compared
            if one.value is not None and other.value
        ]
        drives = [each for each in outcome.drives if each.variant == variant.name]
        parts = [", ".join(costs), *(_road(each, several) for each in drives)]
        words = "; ".join(filter(None, parts)) or "nothing could be compared"
        sentences.append((variant.name, f"{words}."))
    return tuple(sentences)


def _road(drive: DriveRecord, several: bool) -> str:
    where = f"{drive.condition}: " if several else ""
    if drive.difference is None:
        return ""
    gap = drive.difference.driving_score
    points = _signed(f"{where}driving score ", gap)
    if not points:
        value = number(gap.value or 0.0, "+.1f")
        return f"{where}driving score {value} points on {gap.n} route"
    limit = f"{gap.n} routes show none below {drive.difference.smallest_shown:.1f}"
    kept = _signed("; room kept ", drive.difference.room_kept)
    return f"{points}, {drive.difference.verdict}; {limit}{kept}"


def _signed(what: str, gap: Estimate) -> str:
    ends = [each for each in (gap.value, gap.low, gap.high) if each is not None]
    if len(ends) < 3:
        return ""
    value, low, high = (number(each, "+.1f") for each in ends)
    return f"{what}{value} points ({low} to {high})"


@dataclass(frozen=True)
class StudyFiles:
    """Paths of the JSON record, Markdown tables and HTML report of a study."""

    record: Path
    tables: Path
    report: Path


def write_study(
    outcome: StudyResult,
    folder: str | Path,
    command: Sequence[str] = (),
    sections: Sequence[Section] = (),
    *,
    force: bool = False,
) -> StudyFiles:
    """Write JSON, Markdown and HTML, each atomically.

    Args:
        outcome: Results to write.
        folder: Created if needed.
        command: The command line that reproduces the study, word by word.
        sections: Additional sections of the page.
        force: Also replace files that we did not write.

    Raises:
        StudyError: The folder cannot be written.
        GraphError: A file is there that we did not write.
    """
    # paths, and all tables as Markdown
    folder = Path(folder)
    written = StudyFiles(folder / JSON, folder / MARKDOWN, folder / HTML)
    heading = f"{drafts.IN_MARKDOWN}# {in_markdown(outcome.title)}\n\n"
    text = heading + "\n".join(table.markdown() for table in outcome.tables())
    page = study_page(outcome, command, sections)
    # all files are written, or none
    with drafts.written(folder, StudyError):
        folder.mkdir(parents=True, exist_ok=True)
        with (
            writing([written.record, written.tables, written.report], force=force),
            drafts.all_or_none(),
        ):
            write_document(written.record, outcome.to_json(), indent=1)
            write_bytes(written.tables, text.encode())
            write_bytes(written.report, page.html().encode())
    return written
