"""What may be asked of the commands, in Python as on the command line.

A command's options are the fields of its dataclass: their names, types, defaults and
the texts below them, which ``--help`` prints. Nothing heavy is imported here, so that a
command explains itself at once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from cyclopts import Parameter, Token

from me2e_compress.base.errors import OptionError, RecipeError
from me2e_compress.fidelity import ALIVE, SQNR_FLOOR_DB
from me2e_compress.metrics import BUDGET_MS

if TYPE_CHECKING:  # onnxruntime takes a tenth of a second to import
    from me2e_compress.runtime.providers import Provider
else:
    Provider = str  # as the command line has it

# The largest number of an option: beyond, milliseconds are no whole microseconds
LARGEST = 1e15
# Most threads of a session: onnxruntime starts all of them, beyond the cores too
MOST_THREADS = 1024
# Most frames that are made up, all of them in memory
MOST_DRAWN = 1000
# Most inferences that can be asked for: at a millisecond each, a fortnight
MOST_SAMPLES = 10**9
# Most digits of a dimension's size, which must fit into a 64-bit integer
_MOST_DIGITS = 18


def check_number(
    option: str, value: float | None, *, zero: bool = False, most: float = LARGEST
) -> None:
    """Refuse anything but None, a finite number above 0, or 0 if `zero` is set."""
    if value is None or 0 < value <= most or (zero and value == 0):
        return
    least = "0 or above" if zero else "above 0"
    above = f", {most:g} at most" if math.isfinite(value) and value > 0 else ""
    raise RecipeError(
        f"{option} is {value:g}: it must be a finite number {least}{above}"
    )


def check_count(
    option: str, value: int, most: int | None = None, *, least: int = 0
) -> None:
    """Refuse a count below `least`, or above `most` unless that is None."""
    if value < least:
        raise OptionError(f"{option} is {value}: it must be {least} or more")
    if most is not None and value > most:
        raise OptionError(f"{option} is {value}: it must be {most:,} at most")


def _pairs(option: str, form: str, words: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Split ``NAME=VALUE``, each name once."""
    names = set[str]()
    for word in words:
        name, equals, value = word.rpartition("=")
        if not (name and equals and value):
            raise RecipeError(f"{option} is {word!r}: write {form}")
        if name in names:
            raise RecipeError(f"{option} gives {name} twice")
        names.add(name)
        yield name, value


def _sizes(type_: Any, tokens: Sequence[Token]) -> dict[str, int]:
    """Parse sizes of open dimensions, such as ``batch=1`` or ``image:0=1``."""
    form, parsed = "NAME=SIZE, e.g. batch=1", dict[str, int]()
    for name, size in _pairs("--set-dim", form, (token.value for token in tokens)):
        if not size.isdecimal() or len(size) > _MOST_DIGITS:
            raise RecipeError(f"--set-dim is '{name}={size}': write {form}")
        parsed[name] = int(size)
    return parsed


def _joules(type_: Any, tokens: Sequence[Token]) -> dict[str, str | Path | float]:
    """Parse ``NAME=JOULES`` or ``NAME=FILE``."""
    form, parsed = "NAME=JOULES or NAME=FILE", dict[str, str | Path | float]()
    for name, value in _pairs("--joules", form, (token.value for token in tokens)):
        try:
            parsed[name] = float(value)
        except ValueError:
            parsed[name] = value
    return parsed


File: TypeAlias = Annotated[str | Path, Parameter(metavar="FILE")]
Count: TypeAlias = Annotated[int, Parameter(name=["--count", "-n"])]
Sizes: TypeAlias = Annotated[
    Mapping[str, int],
    Parameter(
        "--set-dim", converter=_sizes, n_tokens=-1, accepts_keys=False, metavar="DIM=N"
    ),
]
Joules: TypeAlias = Annotated[
    Mapping[str, str | Path | float],
    Parameter(
        "--joules", converter=_joules, n_tokens=-1, accepts_keys=False, metavar="NAME=J"
    ),
]


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class WriteOptions:
    """What is done about outputs that exist."""

    force: bool = False
    """replace what is there, whoever wrote it"""


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class MapOptions:
    """How nodes find their modules."""

    module_map: Annotated[File | None, Parameter(name="--map")] = None
    """vad, uniad, tcp, highway, or a TOML file"""


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class AdapterOptions:
    """What is known of a model beside its file."""

    adapter: File | None = None
    """adapts the model: A.toml, or see list"""


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class ProviderOptions:
    """What runs graphs."""

    provider: str | Provider = "cpu"
    """runs the graph: cpu, cuda{plugins=[LIB.so]}, ... or see list"""

    @property
    def runs_on(self) -> Provider:
        """The provider; a ProviderError if it does not exist or is not installed."""
        from me2e_compress.runtime.providers import provider_named

        if isinstance(self.provider, str):
            return provider_named(self.provider)
        return self.provider


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraphOptions(MapOptions, AdapterOptions, ProviderOptions):
    """How a graph is read and run."""


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class Int8Options:
    """What becomes int8; None leaves it to the recipe, else the first that is named."""

    scheme: str | None = None
    """int8 modules: full, feature-ext or prediction"""
    rules: str | None = None
    """rules of the int8 plan: safe, paper, or see list"""
    target: str | None = None
    """runtime of the graph: onnxruntime or tensorrt"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class InspectOptions(MapOptions, AdapterOptions):
    """How a graph is read, and what is shown of it."""

    dims: Sizes = dataclasses.field(default_factory=dict)
    """size of an open dimension: batch=1; once for each"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FramesOptions(WriteOptions, GraphOptions):
    """Which frames are made."""

    count: Count = 256
    """number of frames"""
    seed: int = 0
    """seed of everything random"""
    scene_length: int | None = None
    """frames a scene; default 16, of a log all"""
    log: Annotated[str | None, Parameter(name="--from")] = None
    """recorded driving, read by another package: LOG:ROOT; else highway drives"""

    def __post_init__(self) -> None:
        check_count("--count", self.count, MOST_SAMPLES)
        check_count("--seed", self.seed)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanOptions(WriteOptions, MapOptions, Int8Options):
    """How a graph is planned; a plan that is made already takes no options."""

    overrides: File | None = None
    """TOML file of exceptions to the int8 plan"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrateOptions(WriteOptions, GraphOptions):
    """How ranges are measured or imported."""

    recipe: Annotated[File, Parameter(name=["--recipe", "-r"])] = "exact"
    """a TOML file, or a shipped recipe's name; its passes before int8 are run"""
    method: str | None = None
    """calibration method: mse, max-min, percentile:99.9, ...; None: the recipe's"""
    count: Count = 256
    """number of frames, drawn in whole scenes"""
    imported: Annotated[File | None, Parameter(name="--import")] = None
    """what another tool measured; frames then judge its scales alone"""

    def __post_init__(self) -> None:
        if self.method is not None:
            from me2e_compress.calibration.observers import OBSERVERS

            OBSERVERS.parse(self.method)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompressOptions(WriteOptions, GraphOptions, Int8Options):
    """How a graph is compressed; None leaves it to the recipe."""

    overrides: File | None = None
    """TOML file of exceptions to the int8 plan"""
    ranges: File | None = None
    """saved RANGES.json instead of frames"""
    method: str | None = None
    """calibration method: mse, max-min, percentile:99.9, ...; of RANGES.json its own"""
    dims: Sizes = dataclasses.field(default_factory=dict)
    """size of an open dimension: batch=1; once for each"""
    seed: int = 0
    """seed of everything random"""
    verify_frames: int = 2
    """frames to check exact passes on; 0 asks for no proof"""
    measure_frames: int = 16
    """most frames kept out of calibration to measure on; 0 measures nothing"""
    floor: float = SQNR_FLOOR_DB
    """warn of an output below this SQNR, in dB"""
    allow_empty: Annotated[bool, Parameter(parse=False)] = False
    """write the graph although nothing in it became int8"""

    def __post_init__(self) -> None:
        check_count("--seed", self.seed)
        check_count("--verify-frames", self.verify_frames, MOST_DRAWN)
        check_count("--measure-frames", self.measure_frames)
        check_number("--floor", self.floor, zero=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LintOptions(ProviderOptions):
    """The runtime whose rules are checked, and how."""

    target: str | None = None
    """runtime of the graph: onnxruntime or tensorrt; None: whom it was written for"""
    target_version: str | None = None
    """of tensorrt, as 10.13: refuses what came later"""
    trt_check: bool = False
    """also parse and build it by TensorRT-RTX"""
    sm: int = 86
    """GPU generation that is built for"""

    def __post_init__(self) -> None:
        if self.target not in (None, "tensorrt") and (option := self.of_tensorrt):
            raise RecipeError(f"--{option} is for tensorrt, not for {self.target}")
        if self.sm != LintOptions.sm and not self.trt_check:
            raise RecipeError(f"--sm {self.sm} is for --trt-check, which is not given")

    @property
    def of_tensorrt(self) -> str:
        """An option that only TensorRT serves; empty if none is given."""
        version = "" if self.target_version is None else "target-version"
        return "trt-check" if self.trt_check else version


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrialOptions(WriteOptions, GraphOptions, Int8Options):
    """How int8 variants are made and judged."""

    ranges: File | None = None
    """saved RANGES.json instead of frames"""
    count: Count = 4
    """number of frames (to judge on)"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensitivityOptions(TrialOptions):
    """How int8 is judged, and what it may cost."""

    limit: float = 0.1
    """most loss of the recipe: metres of the plan, see above"""
    node_trials: int = 16
    """most variants of the worst module's nodes; 0: none"""

    def __post_init__(self) -> None:
        check_number("--limit", self.limit, zero=True)
        check_count("--node-trials", self.node_trials)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchOptions(TrialOptions):
    """How int8 is judged, and the budgets: one or more."""

    max_mb: float | None = None
    """most MB of weights"""
    max_ms: float | None = None
    """most milliseconds a frame, on this CPU"""
    max_joules: float | None = None
    """most joules a frame, measured by a counter"""

    def __post_init__(self) -> None:
        check_number("--max-mb", self.max_mb)
        check_number("--max-ms", self.max_ms)
        check_number("--max-joules", self.max_joules)
        if (self.max_mb, self.max_ms, self.max_joules) == (None, None, None):
            raise RecipeError(
                "give a budget: --max-mb, --max-ms or --max-joules, or more"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareOptions(GraphOptions):
    """How two graphs run."""

    as_it_stands: Annotated[bool, Parameter(name="--reference")] = False
    """the first without onnxruntime's optimizations, the second with all"""
    alive: float = ALIVE
    """least share of an output's movement that is left; 0: not asked"""

    def __post_init__(self) -> None:
        check_number("--alive", self.alive, zero=True, most=1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProfileOptions(WriteOptions, GraphOptions):
    """How latencies are measured."""

    samples: int | None = None
    """number of latencies; None: one a frame"""
    threads: int = 1
    """of onnxruntime; 0 takes all"""
    by_module: bool = False
    """modules and operators too, in inferences of their own"""
    energy: str | None = None
    """joules too: auto, nvml, recorded:FILE"""
    budget_ms: float = BUDGET_MS
    """what a decision may take; 20 Hz: 50"""

    def __post_init__(self) -> None:
        check_number("--budget-ms", self.budget_ms)
        check_count("--threads", self.threads, most=MOST_THREADS)
        check_count("--samples", self.samples or 0, most=MOST_SAMPLES)


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """Where drives are done, and how many at a time."""

    workers: int = 1
    """processes at a time"""
    engine: str = "local"
    """local, ray, or ray:ADDRESS of a cluster"""

    def __post_init__(self) -> None:
        check_count("--workers", self.workers, least=1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateOptions(WorkerOptions, GraphOptions, WriteOptions):
    """Which routes are driven, and how; an evaluator takes those that it declares."""

    routes: str = "all"
    """routes: all, a number, ID,ID; or a file of routes"""
    latency: str = "none"
    """none, fps:F, trace:FILE, measured, or see list"""
    seed: int = 0
    """seed of everything random"""
    latency_model: Annotated[str, Parameter(parse=False)] = "drop"
    """drop the decisions due meanwhile, or fifo: delay every control"""
    dt_ms: Annotated[float, Parameter(parse=False)] = 50.0
    """step of the simulation; results at different steps are not compared"""
    weather: str = ""
    """fog_m=80,night=0.5,dropped=BACK+FRONT ..."""
    render: str | None = None
    """draw this route as GIF and PNG"""
    evaluator: str = "highway"
    """who drives it: highway, NAME{option=value}, or see list"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("--seed", self.seed)
