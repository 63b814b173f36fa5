"""What one graph is found to do, shrunk and written down."""

import dataclasses
import re
from collections.abc import Iterator

import onnx

from tests.fuzz.exact.drawing import Drawing, drawing
from tests.fuzz.exact.judging import Case, Kind, Verdict, judge
from tests.fuzz.exact.pipelines import Pipeline
from tests.fuzz.exact.running import RefusedError
from tests.fuzz.exact.shrinking import IsAlike, shrink
from tests.fuzz.exact.texts import as_text


@dataclasses.dataclass(frozen=True)
class Judged:
    """A verdict, and the pipeline's name in tables."""

    label: str
    verdict: Verdict


def judged(
    seed: int, drawn: Drawing, pipelines: tuple[Pipeline, ...]
) -> Iterator[Judged]:
    """Judge a drawn graph by some pipelines."""
    try:
        case = Case(drawn.model, seed)
    except RefusedError as error:
        yield Judged("none", Verdict("invalid-draw", "", str(error)))
        return
    for each in pipelines:
        yield Judged(each.label, case.judge(each.text))


def alike(kind: Kind, pipeline: str, seed: int) -> IsAlike:
    """Say of a candidate whether it gets the same kind of verdict."""

    def check(model: onnx.ModelProto) -> bool:
        return judge(model, pipeline, seed).kind == kind

    return check


def signature(found: Verdict) -> tuple[str, str, str]:
    """Return what findings of one cause have in common, roughly."""
    said = re.sub(r"'[^']*'|\b[vcxn]?\d[\d.e+-]*|\S*_\S*", "#", found.detail)
    guilty = found.pipeline.partition("{")[0].partition(",")[0]
    return found.kind, guilty, "" if found.kind == "wrong" else said[:60]


def report(seed: int, found: Verdict) -> str:
    """Shrink a finding and write all that a test needs."""
    whole = drawing(seed)
    small = shrink(whole.model, alike(found.kind, found.pipeline, seed))
    again = judge(small, found.pipeline, seed)
    lines = (
        f"seed {seed}, pipeline {found.pipeline}",
        f"{found.kind}: {found.detail}",
        f"shrunk from {len(whole.model.graph.node)} nodes of {', '.join(whole.motifs)}"
        f" to {len(small.graph.node)}: {again.detail}",
        as_text(small),
    )
    return "\n".join(lines)
