"""Definition of a study: variants, conditions, baseline, routes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.policies import driver_named
from me2e_compress.errors import FramesError, StudyError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.passes import Pass
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.simulator.routes import Route
from me2e_compress.study.condition import (
    Condition,
    check_conditions,
    check_conditions_elsewhere,
    check_pairs,
)
from me2e_compress.study.study_blocks import (
    FramesToRecord,
    StudyBlock,
    check_name,
    check_unique,
)
from me2e_compress.workflows.other_evaluators import HIGHWAY, is_highway


@dataclass(frozen=True)
class Variant:
    """One driver to compare: a file as it is, or the result of passes.

    Args:
        name: Letters, digits, ``_``, ``+`` and ``-``; names its folder of results.
        policy: A policy by name, ``blind:8``, or the path of an ONNX file.
        passes: Passes applied to the file; none leaves it as it is.
        module_map: Preset or TOML file for the passes; None finds the preset.
        adapter: TOML file that adapts the model to the policy contract.
        trace: Latencies recorded on a device; None measures them here.
        host_stage: Changes the model's plan on the host, as a text; a trace does not
            include its time, see the latency source ``host-stage``.

    Raises:
        StudyError: The name is invalid, or passes, an adapter or a trace lack a model.
    """

    name: str
    policy: str
    passes: tuple[Pass, ...] = ()
    module_map: str | None = None
    adapter: Path | None = None
    trace: Path | None = None
    host_stage: str = ""

    def __post_init__(self) -> None:
        check_name("variant", self.name)
        options = (
            *(self.passes, self.module_map, self.adapter, self.trace),
            self.host_stage,
        )
        if not self.is_model and any(options):
            raise StudyError(
                f"variant {self.name}: {self.policy} is not a model: there is nothing "
                "to compress, adapt or time"
            )

    @property
    def is_model(self) -> bool:
        """Whether the driver is an ONNX file."""
        return isinstance(driver_named(self.policy), OnnxDriver)


@dataclass(frozen=True)
class Timing:
    """How latencies are measured, and which device they represent.

    Args:
        samples: Timed inferences per model.
        threads: Threads of onnxruntime.
        baseline_median_s: Median latency of the baseline on the target device; it sets
            one scale for all models. None takes this machine as it is.

    Raises:
        StudyError: A number is not positive.
    """

    samples: int = 200
    threads: int = 1
    baseline_median_s: float | None = None

    def __post_init__(self) -> None:
        median_s = self.baseline_median_s
        if self.samples < 1 or self.threads < 1:
            raise StudyError(
                f"latency: {self.samples} samples on {self.threads} threads: both must "
                "be 1 or more"
            )
        if median_s is not None and not 0.0 < median_s < float("inf"):
            raise StudyError(f"latency: a median of {median_s} s is not positive")


@dataclass(frozen=True)
class Study:
    """Variants x conditions on the same routes.

    Args:
        title: Title of the report.
        variants: In the order of the tables.
        conditions: In the order of the tables.
        baseline: Name of the variant that the others are compared with.
        set_size: Number of routes of the whole set.
        frames: Folder of recorded frames that passes calibrate on.
        held_out: Folder of other frames, for measuring fidelity and latency.
        seed: Seed of bootstraps, of passes and of draws from traces.
        provider: Execution provider for all models.
        to_record: Frames that the study records itself; None uses the folders.
        blocks: Which variants drive under which conditions; empty means all under all.
            Under each condition the baseline drives too.
        pairs: Drives to compare, ``VARIANT.CONDITION`` of both.
        evaluator: ``highway``, or another evaluator by its name and options, with
            routes and conditions of its own.

    Raises:
        StudyError: There is nothing to drive, a name is repeated or unknown, the seed
            is negative, or passes or a trace lack frames.
    """

    title: str
    variants: tuple[Variant, ...]
    conditions: tuple[Condition, ...]
    baseline: str
    routes: tuple[Route, ...]
    set_size: int
    frames: Path | None = None
    held_out: Path | None = None
    timing: Timing = field(default_factory=Timing)
    seed: int = 0
    provider: Provider = CPU
    to_record: FramesToRecord | None = None
    blocks: tuple[StudyBlock, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()
    evaluator: str = HIGHWAY

    def __post_init__(self) -> None:
        # names must be unique, and refer to something
        check_unique("variant", (variant.name for variant in self.variants))
        check_unique("condition", (condition.name for condition in self.conditions))
        names = [variant.name for variant in self.variants]
        if self.baseline not in names:
            raise StudyError(
                f"baseline {self.baseline!r} is not a variant; there are"
                f" {', '.join(names)}"
            )
        check_conditions(self.conditions, names)
        check_pairs(self.pairs, names, [each.name for each in self.conditions])
        # routes belong to highway only
        if self.elsewhere:
            self._check_elsewhere()
        elif not self.routes:
            raise StudyError(f"{self.title}: there is no route to drive")
        if self.seed < 0:
            raise StudyError(f"seed {self.seed}: must be 0 or more")
        # blocks name variants and conditions
        for block in self.blocks:
            block.check(names, [each.name for each in self.conditions])
        if self.to_record is None:
            self._check_frames()

    @property
    def preview(self) -> str:
        """Suffix of titles if only a part of the routes is driven; empty otherwise."""
        driven, whole = len(self.routes), self.set_size
        partial = 0 < driven < whole
        return f" (preview: {driven} of {whole} routes)" if partial else ""

    @property
    def elsewhere(self) -> bool:
        """Whether an evaluator other than highway drives."""
        return not is_highway(self.evaluator)

    def _check_elsewhere(self) -> None:
        adapted = [each.name for each in self.variants if each.adapter is not None]
        for what, given in (
            ("routes", bool(self.routes)),
            (f"the adapter of {', '.join(adapted)}", bool(adapted)),
        ):
            if given:
                raise StudyError(
                    f"{what}: only highway understands that, not {self.evaluator}"
                )
        check_conditions_elsewhere(self.evaluator, self.conditions)

    def _check_frames(self) -> None:
        # passes that calibrate need frames
        needy = [
            (variant.name, each.name)
            for variant in self.variants
            for each in variant.passes
            if each.needs_frames
        ]
        if needy and self.frames is None:
            raise StudyError(
                f"variant {needy[0][0]}: {needy[0][1]} measures on recorded frames,"
                " and there are none (frames = FRAMES)"
            )
        # models without a trace are timed on held-out frames
        untimed = [each for each in self.variants if each.is_model and not each.trace]
        traced = [each.name for each in self.conditions if each.traced]
        if traced and untimed and self.held_out is None:
            raise StudyError(
                f"condition {traced[0]}: the latency of {untimed[0].name} is measured "
                "on held-out frames, and there are none (held_out = FRAMES)"
            )

    def inputs(self) -> Iterator[str | Path]:
        """List the files and folders that it reads."""
        yield from filter(None, (self.frames, self.held_out))
        yield from self.provider.plugins
        for each in self.variants:
            named = (each.policy, each.module_map, each.adapter, each.trace)
            yield from filter(None, named)
            yield from (file for step in each.passes for file in step.files())

    def check_recordings(self) -> None:
        """Check that its recordings are valid and its variants' files exist."""
        for each in self.variants:
            for key, file in (("adapter", each.adapter), ("trace", each.trace)):
                if file is not None and not file.is_file():
                    raise StudyError(f"variant {each.name}: {key} {file}: no such file")
        for name, folder in (("frames", self.frames), ("held_out", self.held_out)):
            if folder is None:
                continue
            try:
                CalibrationSet(folder)
            except FramesError as error:
                raise StudyError(f"{name}: {error}") from error

    def driven_under(self, condition: Condition) -> tuple[Variant, ...]:
        """Return the variants under a condition, with the baseline if there are any."""
        if not self.blocks:
            return self.variants
        blocks = [each for each in self.blocks if condition.name in each.conditions]
        wanted = {name for each in blocks for name in (*each.variants, self.baseline)}
        return tuple(each for each in self.variants if each.name in wanted)

    def of_blocks(self, names: Sequence[str]) -> "Study":
        """Return the part that some blocks need."""
        there = {each.name: each for each in self.blocks}
        chosen = list[StudyBlock]()
        for name in names:
            if name not in there:
                known = ", ".join(there) or "none"
                raise StudyError(f"no block {name}; there are {known}")
            chosen.append(there[name])
        drive = {self.baseline, *(name for each in chosen for name in each.variants)}
        under = {name for each in chosen for name in each.conditions}
        return replace(
            self,
            blocks=tuple(chosen),
            variants=tuple(each for each in self.variants if each.name in drive),
            conditions=tuple(each for each in self.conditions if each.name in under),
        )

    @property
    def reference(self) -> Variant:
        """The baseline variant."""
        return next(each for each in self.variants if each.name == self.baseline)
