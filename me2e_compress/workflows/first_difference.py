"""Find the first module after which a graph differs from its source."""

import dataclasses
import itertools
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.adapter.outputs import adapted
from me2e_compress.errors import ModuleMapError
from me2e_compress.fidelity.first_difference import (
    BorderValue,
    FirstDifference,
    find_first_difference,
)
from me2e_compress.graph import provenance
from me2e_compress.graph.modules import ModuleMap, assign, map_of
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table, counted, number, table

FRAMES = 2
"""The second frame is compared: it reads the state of the first."""


@dataclasses.dataclass(frozen=True, repr=False)
class FirstDifferenceResult(Result):
    """Where a graph begins to differ from its source."""

    reference: Path
    candidate: Path
    found: FirstDifference

    @property
    def headline(self) -> str:
        """The first module that differs."""
        return headline_of(self.found)

    def tables(self) -> tuple[Table, ...]:
        """Return the worst value that each module hands on."""
        worst: dict[str, BorderValue] = {}
        for each in self.found.values:
            known = worst.setdefault(each.module, each)
            if each.sqnr_db < known.sqnr_db:
                worst[each.module] = each
        rows = [
            (each.module or "-", each.value, each.node, number(each.sqnr_db, ".1f"))
            for each in worst.values()
        ]
        columns = ("module", "worst value", "node", "SQNR dB")
        note = (
            f"Of {counted(len(self.found.values), 'value')} that modules hand on."
            f" {self.found.unknown} of either graph have no namesake in the other."
        )
        return (table("Modules", columns, rows, note, words=3),)

    def to_json(self) -> object:
        """Return all that was compared."""
        return self.found


def headline_of(found: FirstDifference) -> str:
    """Name the first module that differs, or say that there is none."""
    if found.first is not None:
        return f"first below {found.floor_db:g} dB: {found.first}"
    below = sum(each.sqnr_db < found.floor_db for each in found.values)
    if not below:
        return (
            f"no difference: {counted(len(found.values), 'value')} at"
            f" {found.floor_db:g} dB or more"
        )
    return (
        f"{below} of {counted(len(found.values), 'value')} are below"
        f" {found.floor_db:g} dB, but no output is"
    )


def first_difference(
    reference: str | Path,
    candidate: str | Path,
    frames: str | Path,
    listener: Listener = SILENT,
    *,
    provider: Provider = CPU,
    adapter: str | Path | None = None,
    module_map: str | Path | None = None,
) -> FirstDifferenceResult:
    """Find the first module after which the second graph differs.

    Both graphs run on one frame, their nodes as they stand, and what their modules hand
    on is compared by name. A value differs below 80 dB, or below 20 dB where a graph
    holds int8 or mostly narrow floats. The adapter's TOML says which outputs are fed
    back.

    Raises:
        EvaluationError: The graphs share no value.
        FramesError: A frame does not fit one of the graphs.
        GraphError: A model does not exist or run.
        ProviderError: The provider is not available.
    """
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
    shown = tuple(itertools.islice(recording, FRAMES))
    found = find_first_difference(models[paths[0]], models[paths[1]], shown, provider)
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
