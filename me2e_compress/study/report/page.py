"""The HTML page of a study, built from a template."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup

from me2e_compress.marks import MARK
from me2e_compress.study.all_tables import near_misses, route_table
from me2e_compress.study.report.curves import curves
from me2e_compress.study.report.figures import forest, pareto
from me2e_compress.study.report.findings import findings
from me2e_compress.study.route_summary import RouteSummary
from me2e_compress.study.side_by_side import Contrast
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.tables import (
    abilities,
    change_tables,
    differences,
    scoreboards,
)
from me2e_compress.workflows.result import Table

TEMPLATE = "report.html"


@dataclass(frozen=True)
class Section:
    """An additional section: a heading, tables, and named files to link."""

    title: str
    tables: tuple[Table, ...] = ()
    files: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Shown:
    """A contrast with its picture as a data URI."""

    title: str
    words: str
    uri: str


def template(name: str) -> Template:
    """Return one of the page templates, with autoescape on."""
    return Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template(name, globals={"mark": MARK})


def html(
    outcome: StudyResult,
    command: Sequence[str] = (),
    sections: Sequence[Section] = (),
) -> str:
    """Build the whole page, which is self-contained."""
    study = outcome.study
    return template(TEMPLATE).render(
        title=f"{study.title}{study.preview}",
        preview=study.preview,
        baseline=study.baseline,
        lede=_lede(outcome),
        alerts=outcome.alerts(),
        routes=route_table(outcome),
        sections=sections,
        findings=findings(outcome),
        scoreboards=scoreboards(outcome),
        curves=_markup(curves(outcome)),
        differences=differences(outcome) if len(outcome.variants) > 1 else None,
        changes=change_tables(outcome),
        forest=_markup(forest(outcome)),
        fronts=[
            (each.name, _markup(drawn))
            for each in study.conditions
            if (drawn := pareto(outcome, each)) is not None
        ],
        near_misses=near_misses(outcome),
        abilities=abilities(outcome),
        contrasts=[_shown(each, study.baseline) for each in outcome.contrasts],
        made=_made(outcome, command),
        variants=[_recipe(each.name, outcome) for each in outcome.variants],
    )


def _lede(outcome: StudyResult) -> str:
    # what was driven
    study = outcome.study
    driven, whole = outcome.coverage
    share = f"{driven}" if driven == whole else f"{driven} of {whole}"
    where = f"of {study.evaluator}" if study.elsewhere else "of highway-env"
    names = ", ".join(each.name for each in study.conditions)
    said = (
        f"{_count(len(study.variants), 'variant')} on {share} routes {where}, "
        f"closed loop; {_count(len(study.conditions), 'condition')}: {names}."
    )
    # what so many routes can show
    found = [each.difference for each in outcome.drives if each.difference is not None]
    if not found:
        return said
    least = max(each.smallest_shown for each in found)
    return (
        f"{said} {_count(driven, 'route')} cannot show a difference below {least:.1f}"
        " points of driving score."
    )


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _shown(contrast: Contrast, baseline: str) -> Shown:
    route = contrast.route
    return Shown(
        f"{route.scenario}, {contrast.condition}, "
        f"{contrast.time_us / 1e6:.1f} s into the route {route.route}; "
        f"at most {contrast.apart_m:.1f} m apart",
        f"{baseline}, in grey: {_ended(route)}; {contrast.variant}, in colour:"
        f" {_ended(contrast.other)}",
        _data_uri(contrast.picture),
    )


def _ended(route: RouteSummary) -> str:
    return f"driving score {route.driving_score:.1f}, {route.fate}"


def _recipe(name: str, outcome: StudyResult) -> tuple[str, str, str]:
    """Return name, source and the first digits of the digest."""
    prepared = outcome.variant(name).prepared
    made_of = prepared.source or prepared.variant.policy
    if prepared.pipeline:
        made_of = f"{made_of} → {prepared.pipeline}"
    if prepared.weights:
        made_of = f"{made_of}; {prepared.weights}"
    return name, made_of, (prepared.sha256 or "")[:12]


def _made(outcome: StudyResult, command: Sequence[str]) -> list[tuple[str, str]]:
    study, timing = outcome.study, outcome.study.timing
    versions = ", ".join(f"{name} {text}" for name, text in outcome.versions.items())
    load = "" if outcome.load is None else f"; while it was timed, {outcome.load}"
    rows = [("Command", " ".join(command)), ("Machine", f"{outcome.machine}{load}")]
    if outcome.timed:
        rows.append(
            (
                "Latency",
                f"{timing.samples} inferences a model, in turn, on "
                f"{_count(timing.threads, 'thread')}; device scale "
                f"{outcome.device_scale:.3g}",
            )
        )
    rows += [("Versions", versions), ("Seed", str(study.seed))]
    return [(name, text) for name, text in rows if text]


def _data_uri(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"


def _markup(drawing: str | None) -> Markup | None:
    return None if drawing is None else Markup(drawing)
