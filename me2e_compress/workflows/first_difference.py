"""Find the first module and node after which a graph differs from its source."""

import dataclasses
import itertools
import math
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.adapter.stated import adapted
from me2e_compress.errors import ModuleMapError
from me2e_compress.fidelity.first_difference import FirstDifference, Source
from me2e_compress.fidelity.places import Place
from me2e_compress.graph import provenance
from me2e_compress.graph.modules import ModuleMap, assign, map_of
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.workflows.checks import check_count, model_path
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table, counted, number, table

FRAMES = 2
"""Frames that are looked at: the second one reads the state of the first."""


@dataclasses.dataclass(frozen=True, repr=False)
class FirstDifferenceResult(Result):
    """Where a graph begins to differ from its source."""

    reference: Path
    candidate: Path
    found: FirstDifference

    @property
    def headline(self) -> str:
        """The first wrong module and node."""
        return told_of(self.found)

    def tables(self) -> tuple[Table, ...]:
        """Return the places, and what every module was given and gave."""
        found = self.found
        rows = [
            (
                each.module or "-",
                each.value,
                each.named,
                number(each.sqnr_db, ".1f"),
                number(each.own_db, ".1f"),
            )
            for each in found.places
        ]
        columns = ("module", "value", "nodes", "SQNR dB", "alone dB")
        note = (
            "One of the nodes makes the value another than in the first graph. Alone:"
            " the same nodes, run on the first graph's values."
        )
        places = (table("Where they differ", columns, rows, note, words=3),)
        modules = [
            (
                each.module or "-",
                f"{each.compared}",
                number(each.before_db, ".1f"),
                number(each.after_db, ".1f"),
            )
            for each in found.modules
        ]
        return (
            *(places if rows else ()),
            table(
                f"Modules over {counted(found.frames, 'frame')}",
                ("module", "values", "before, dB", "after, dB"),
                modules,
                "The lowest SQNR of what a module was given and gave, estimated by 16"
                f" projections of every value. {found.unknown} values of the second"
                " graph are none of the first's, and not judged.",
            ),
        )

    def records(self) -> list[dict[str, object]]:
        """Return one row per place."""
        return [dataclasses.asdict(each) for each in self.found.places]

    def to_json(self) -> object:
        """Return all that was found."""
        return dataclasses.asdict(self.found)


def told_of(found: FirstDifference) -> str:
    """Name the first wrong module and node, or say that there is none."""
    if found.first is not None:
        return _told(found.first, found)
    if not found.different:
        return (
            f"no difference: {counted(found.compared, 'value')} at"
            f" {found.floor_db:g} dB or more"
        )
    of = f"{found.different} of {counted(found.compared, 'value')}"
    if found.outputs_differ:
        end = "every place that was tried is right on equal inputs: rounding grew"
    else:
        end = "none of that reaches an output"
    return f"{of} are below {found.floor_db:g} dB, but {end}"


def _told(first: Place, found: FirstDifference) -> str:
    begin = f"first below {found.floor_db:g} dB" if found.lossy else "first difference"
    module = f"module {first.module}, " if first.module else ""
    # of equal inputs the nodes are wrong, or only what they read was
    own = first.own_db
    alone = f"{own:.1f} dB" if own is not None else "not measured"
    if own is not None and own >= found.floor_db:
        alone = "right" if own == math.inf else f"{own:.1f} dB: the loss adds up"
    more = len([each for each in found.places if each.reaches]) - 1
    others = f"; {counted(more, 'other place')} beside it" if more else ""
    return (
        f"{begin}: {module}{first.named}: {first.value} is at {first.sqnr_db:.1f} dB;"
        f" alone, on the first graph's values: {alone}{others}"
    )


def first_difference(
    reference: str | Path,
    candidate: str | Path,
    frames: str | Path,
    listener: Listener = SILENT,
    *,
    floor_db: float | None = None,
    most_frames: int = FRAMES,
    provider: Provider = CPU,
    adapter: str | Path | None = None,
    module_map: str | Path | None = None,
) -> FirstDifferenceResult:
    """Find the first module and node after which the second graph differs.

    Both graphs run once, their nodes as they stand, with a sketch of every value; the
    places that are suspected run once more, alone, on the first graph's values.
    `floor_db` None is 100 dB, rounding, and 20 dB where a graph holds int8 or
    mostly narrow floats. The adapter's TOML says which outputs are fed back.

    Raises:
        EvaluationError: The graphs share no value, or compute none.
        FramesError: A frame does not fit one of the graphs.
        GraphError: A model does not exist or run.
        ProviderError: The provider is not available.
    """
    check_count("most_frames", most_frames, 1)
    paths = model_path(reference), model_path(candidate)
    recording = CalibrationSet(Path(frames))
    models = dict[Path, ir.Model]()
    for path in dict.fromkeys(paths):
        loaded = graph.load(path)
        adapted(loaded, adapter, module_map)
        recording.check(loaded)
        try_first(
            loaded, path.name, recording, listener=listener, file=path,
            provider=provider,
        )  # fmt: skip
        models[path] = with_modules(loaded)
    # the source runs once, then the other graph
    shown = tuple(itertools.islice(recording, most_frames))
    listener.on_progress("sketches", 0, 2, str(paths[0]))
    source = Source.of(models[paths[0]], shown, provider)
    listener.on_progress("sketches", 1, 2, str(paths[1]))
    found = source.first_difference(models[paths[1]], floor_db)
    listener.on_progress("sketches", 2, 2, "")
    return FirstDifferenceResult(*paths, found)


def with_modules(model: ir.Model) -> ir.Model:
    """Write the module of every node into its metadata, where it does not stand yet."""
    if provenance.missing(model):
        try:
            placed = assign(model, map_of(model, None))
        except ModuleMapError:  # names that the preset needs are lost
            placed = assign(model, ModuleMap.whole())
        for node, place in placed.placements.items():
            if provenance.read(node) is None:
                past = provenance.Provenance(place.module, (node.name or "",))
                provenance.stamp(node, past)
    return model
