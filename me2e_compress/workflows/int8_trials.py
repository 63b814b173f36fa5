"""A model that is calibrated once, for the trials of ``sensitivity`` and ``search``."""

import dataclasses
from contextlib import AbstractContextManager
from pathlib import Path

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.sample import draw
from me2e_compress.driving.adapter.outputs import adapted
from me2e_compress.fidelity.sensitivity import Int8Choice, Trials, write_recipe
from me2e_compress.manager import recipe
from me2e_compress.quantization.rules import DEFAULT_RULES, RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets import DEFAULT_TARGET, TARGETS
from me2e_compress.workflows.checks import (
    load_map,
    output_path,
)
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import Listener
from me2e_compress.workflows.prepare_int8 import PreparedGraph


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrialOptions:
    """How int8 variants are made and judged.

    Attributes:
        scheme: modules that may be int8: ``feature-ext``, ``prediction``, ``full``.
        rules: rules of the int8 plans.
        target: runtime of the int8 graph.
        ranges: file of saved ranges, instead of calibrating.
        module_map: preset or TOML file; None finds the preset.
        count: number of frames to judge on.
        adapter: TOML file that says which output is the plan, and which are fed back.
        provider: what runs the graphs.
        force: replace outputs that we did not write, too.
    """

    scheme: str = "full"
    rules: str = DEFAULT_RULES
    target: str = DEFAULT_TARGET
    ranges: str | Path | None = None
    module_map: str | Path | None = None
    count: int = 4
    adapter: str | Path | None = None
    provider: Provider = CPU
    force: bool = False


@dataclasses.dataclass(frozen=True)
class TrialFiles:
    """Where trials read and write: float model, folder of frames, and the recipe."""

    model: Path
    frames: Path
    output: Path

    def claimed(self, options: TrialOptions) -> AbstractContextManager[None]:
        """Claim the recipe and its overrides while they are made."""
        output = output_path(self.output)
        named = (options.ranges, options.module_map, options.adapter)
        read = (self.model, self.frames, *named)
        overrides = output.with_name(output.stem + ".overrides.toml")
        return writing([output, overrides], read, force=options.force)

    def trials(
        self, options: TrialOptions, listener: Listener
    ) -> tuple[Trials, tuple[str, ...]]:
        """Prepare the graph, calibrate once, and name the modules to try."""
        # check names and frames before anything is run
        rules, place = RULE_SETS.parse(options.rules), TARGETS.parse(options.target)
        loaded = graph.load(self.model)
        adapted(loaded, options.adapter, options.module_map)
        recording = CalibrationSet(self.frames)
        recording.check(loaded)
        scheme = QuantScheme.named(options.scheme, load_map(options.module_map, loaded))
        # the graph is opened and prepared once; every trial starts from there
        name = self.model.name
        try_first(
            loaded,
            name,
            listener=listener,
            file=self.model,
            frames=recording,
            provider=options.provider,
        )
        ready = PreparedGraph.of(self.model, loaded, options.module_map)
        made = Trials(
            ready.model,
            ready.modules,
            rules,
            place,
            _ranges(ready, recording, options, listener),
            draw(recording, options.count, 0),
            provider=options.provider,
        )
        return made, scheme.modules

    def write(self, choice: Int8Choice, options: TrialOptions) -> str:
        """Write the recipe, and return a line that says what it makes int8."""
        before = [each.name for each in recipe.load("exact")]
        overrides = write_recipe(
            self.output, choice, before, options.rules, options.target
        )
        listed = ", ".join(choice.modules) or "no module"
        more = f", {len(choice.floats)} of their nodes in float" if overrides else ""
        return f"{self.output}: int8 in {listed}{more}"


def _ranges(
    ready: PreparedGraph,
    recording: CalibrationSet,
    options: TrialOptions,
    listener: Listener,
) -> Ranges:
    tensors = ready.tensors()
    if options.ranges is not None:
        ranges = Ranges.load(Path(options.ranges))
        digest = graph.digest(ready.model)
        ranges.check(
            model=digest, tensors=tensors, method=ranges.method, named=options.ranges
        )
        return ranges
    method = RULE_SETS.parse(options.rules).method
    return Calibrator(method, provider=options.provider).run(
        ready.model,
        tensors,
        recording,
        lambda done, of: listener.on_progress("calibrate", done, of, ""),
    )
