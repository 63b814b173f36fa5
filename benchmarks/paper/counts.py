"""Int8 parts of each file, and collisions of each drive."""

from collections import Counter

from benchmarks.paper.drives import SCHEMES, ModelFacts, PaperDrives
from benchmarks.paper.published import INT8_COUNTS
from me2e_compress.base.display import Cell, Table
from me2e_compress.metrics.episode import InfractionKind
from me2e_compress.study.cells import MISSING

PARTNERS = (
    InfractionKind.COLLISION_VEHICLE,
    InfractionKind.COLLISION_PEDESTRIAN,
    InfractionKind.COLLISION_LAYOUT,
)
COUNTS = ("tensors", "int8 operators", "compute-intensive", "MB")


def table_4(result: PaperDrives) -> Table:
    """Show the int8 parts of each file, with the paper's counts in separate columns."""
    # other stacks are named "stack scheme"
    stacks = dict.fromkeys(
        each.variant.rsplit(" ", 1)[0] for each in result.facts if each.of_another_stack
    )
    rows = [_row(result.fact(scheme), scheme, "UniAD") for scheme in SCHEMES]
    for stack in stacks:
        paper = "VAD" if "vad" in stack.lower() else "UniAD"
        rows += [
            _row(result.fact(f"{stack} {scheme}"), scheme, paper) for scheme in SCHEMES
        ]
    return Table(
        f"Table 4: what is int8{result.study.preview}",
        ("file", *COUNTS, "paper's stack", *(f"paper's {each}" for each in COUNTS)),
        tuple(rows),
        "Tensors: activations that are quantized; int8 operators: layers, attention"
        " products and residual Adds that read int8; compute-intensive: convolutions"
        " and matrix products among them; MB of the whole file, 1e6 bytes. The counts"
        " differ from the paper's because the graphs do: the driver has 1.5 M"
        " parameters and UniAD about 90 M; most of the driver's layers stand behind its"
        " BEV encoder, most of UniAD's before; and the rules here leave geometry,"
        " attention weights and small products in float. The paper's VAD, 140.50 MB,"
        " is smaller than VAD-tiny's own 39.9 M parameters, 159.5 MB: what it left out"
        " it does not say.",
    )


def _row(fact: ModelFacts, scheme: str, stack: str) -> tuple[Cell, ...]:
    # what is counted here
    why, size = fact.failure or "not weighed", fact.size_bytes
    shown = Cell(MISSING, reason=why) if size is None else Cell(f"{size / 1e6:.2f}")
    counts = [
        Cell(MISSING, reason=why if size is None else "nothing of it is int8")
    ] * 3
    if fact.int8 is not None:
        counts = [Cell(str(count)) for count in vars(fact.int8).values()]
    # what the paper counted
    *theirs, megabytes = vars(INT8_COUNTS[stack, scheme]).values()
    given = [Cell("" if each is None else str(each)) for each in theirs]
    cells = [Cell(fact.variant), *counts, shown, Cell(stack), *given]
    return *cells, Cell(f"{megabytes:.2f}")


def partners(result: PaperDrives) -> Table:
    """Show what was hit, as shares of the collisions."""
    # shares of each kind of partner, by drive
    rows = []
    for each in result.finished:
        found = Counter(kind for route in each.routes for kind, _ in route.collisions)
        total = found.total()
        rows.append(
            (
                Cell(each.variant),
                Cell(each.condition),
                Cell(str(total)),
                *(_share(found[kind], total) for kind in PARTNERS),
            )
        )
    return Table(
        f"Collisions by partner{result.study.preview}",
        ("variant", "condition", "collisions", "vehicle", "pedestrian", "static"),
        tuple(rows),
        "Share of all collisions, and their number. The paper: 55 % with static"
        " structures where seg is away (schemes 2 and 6).",
        words=2,
    )


def _share(count: int, total: int) -> Cell:
    if not total:
        return Cell(MISSING, reason="no collision")
    return Cell(f"{count / total:.0%}", str(count))
