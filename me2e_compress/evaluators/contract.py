"""What is driven, and by whom: a `Drive`, and the interface of evaluators.

Neither imports highway-env.
"""

import abc
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

from pydantic import TypeAdapter, ValidationError

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import Listener
from me2e_compress.base.registry import Registry
from me2e_compress.driving.contract import RouteInfo
from me2e_compress.driving.latency import FixedLatency, LatencySource
from me2e_compress.driving.policies import Driver, opened
from me2e_compress.driving.realtime import DT_US, LatencyModel
from me2e_compress.metrics.episode import FRAME_US, Episode
from me2e_compress.simulator.camera_rig import CLEAR, Weather
from me2e_compress.simulator.routes import Route
from me2e_compress.version import __version__

FRAME_LIMIT_S = 60.0


@dataclass(frozen=True)
class Driven:
    """An episode, the wall-clock seconds and the resident memory that it took."""

    episode: Episode
    seconds: float
    memory_bytes: int


class Engine(Protocol):
    """Drives independent routes of highway-env, several at a time."""

    def drive(
        self, policy: Driver, drive: "Drive", routes: Sequence[Route]
    ) -> Iterator[Driven]:
        """Yield each route once, as it finishes; routes begin in the order given."""
        ...


@dataclass(frozen=True)
class Drive:
    """Which routes are driven, and under which conditions.

    Raises:
        EvaluationError: The latency lacks its trace, or the step divides no frame.
    """

    # What each decision costs; its seed is that of its draws
    latency: LatencySource = field(default_factory=FixedLatency)
    # Step of the world, a divisor of 50 ms; `realtime.skipped_decisions` tells what a
    # finer one changes. Frames are recorded every 50 ms regardless.
    dt_us: int = DT_US
    weather: Weather = CLEAR  # clear is what each route says
    # Whether a latency drops decisions or delays every control
    latency_model: LatencyModel = LatencyModel.DROP
    # In the order of the results; none where the evaluator alone knows them
    routes: Sequence[RouteInfo] = ()
    # Number of routes of the whole set; 0 where the evaluator knows it
    set_size: int = 0
    # Where routes are driven; None for one at a time on this machine
    engine: Engine | None = None
    # A decision that takes longer makes the policy count as hung
    frame_limit_s: float = FRAME_LIMIT_S

    def __post_init__(self) -> None:
        if self.latency.lacks_trace:
            raise EvaluationError(
                f"latency {self.latency}: its trace names no file (trace:FILE), and "
                "only a study knows each model's own latencies"
            )
        if self.dt_us <= 0 or FRAME_US % self.dt_us:
            words = f"it must divide {FRAME_US // 1000} ms"
            raise EvaluationError(f"a step of {self.dt_us / 1e3:g} ms: {words}")

    @classmethod
    def of_words(
        cls, latency_model: str = "drop", dt_ms: float = 50.0, weather: str = ""
    ) -> Self:
        """Parse the options that the command, a study's file and Python share.

        The weather is ``fog_m=80,night=0.5,dropped=BACK+FRONT``.

        Raises:
            EvaluationError: An option is invalid.
        """
        if latency_model not in list(LatencyModel):
            words = f"no latency model {latency_model!r}; there are"
            raise EvaluationError(f"{words} {', '.join(LatencyModel)}")
        if not 0 < dt_ms <= FRAME_US / 1000:  # a product of inf is no integer
            words = f"it must divide {FRAME_US // 1000} ms"
            raise EvaluationError(f"a step of {dt_ms:g} ms: {words}")
        # Weather is option=value pairs; dropped cameras are joined by +
        options: dict[str, object] = {}
        for pair in filter(None, weather.split(",")):
            name, _, value = pair.partition("=")
            options[name.strip()] = value.split("+") if name == "dropped" else value
        try:
            conditions = TypeAdapter(Weather).validate_python(options)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            names = ", ".join(Weather.__dataclass_fields__)
            raise EvaluationError(
                f"weather option {first['loc'][0]}: {first['msg']}; there are {names}"
            ) from error
        model, dt_us = LatencyModel(latency_model), round(dt_ms * 1000)
        return cls(dt_us=dt_us, weather=conditions, latency_model=model)

    def conditions(self) -> dict[str, Any]:
        """Return everything but routes that decides episodes, as JSON."""
        weather = asdict(self.weather)
        return {
            "latency": self.latency.to_json(),
            "latency_model": self.latency_model.value,
            "dt_us": self.dt_us,
            "weather": weather | {"dropped": list(weather["dropped"])},
        }


# What an evaluator may declare that it takes: options of the command or of a study
ABILITIES = (
    "policy",
    "adapter",
    "module_map",
    "provider",
    "routes",
    "latency",
    "latency_model",
    "dt_ms",
    "weather",
    "engine",
    "render",
)
# Methods that an evaluator with an ability must define
METHODS = {"routes": ("routes",), "render": ("render", "routes")}


@dataclass(frozen=True)
class Evaluator(abc.ABC):
    """Drives a policy, or reads how one drove; it scores nothing.

    Derive a frozen dataclass: its fields are options of its own. ``takes`` names those
    of `ABILITIES` that it understands; commands and studies refuse all others.
    """

    name: ClassVar[str]
    takes: ClassVar[frozenset[str]] = frozenset()

    @abc.abstractmethod
    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        """Yield one episode a route of the drive as it ends, in any order.

        Without routes in the drive, all of its own, in a fixed order. The same options
        give the same episodes, but where latency is measured. The caller stores the
        episodes; ``folder`` is for anything else, e.g. a log beside it.

        Raises:
            EvaluationError: It cannot go on; the message is one line.
        """

    def routes(
        self, words: str, beside: Path = Path()
    ) -> tuple[Sequence[RouteInfo], int]:
        """Return the routes that words name, and the size of their set.

        Files are looked up in the folder ``beside``.

        Raises:
            EvaluationError: There is no such route, or no file of routes.
        """
        raise NotImplementedError

    @property
    def label(self) -> str:
        """The name in reports."""
        return EVALUATORS.text(self)

    @property
    def set_size(self) -> int:
        """The number of routes of the whole set, where a drive names none; 0: those."""
        return 0

    def check_policy(self, policy: Driver) -> None:
        """Check that a policy can drive here, before anything is written.

        Raises:
            EvaluationError: It cannot be opened, or lacks a member.
        """
        opened(policy)

    def made_by(self, policy: Driver | None, drive: Drive) -> dict[str, Any]:
        """Return all that decides the results but the routes; see `check_policy`."""
        if policy is not None:
            self.check_policy(policy)
        made = {
            "version": __version__,
            "evaluator": EVALUATORS.text(self),
            "policy": "" if policy is None else policy.fingerprint(),
        }
        usual, asked = Drive().conditions(), drive.conditions()
        return made | {key: asked[key] for key in asked if asked[key] != usual.get(key)}

    def render(
        self, policy: Driver, drive: Drive, route: RouteInfo, folder: Path
    ) -> tuple[Path, ...]:
        """Drive a route again, draw it, and return the pictures' files."""
        raise NotImplementedError

    def check_takes(self, options: Iterable[str], whose: str = "") -> None:
        """Raise an EvaluationError at the first option that it does not take."""
        for option in options:
            if option not in self.takes:
                takes = ", ".join(name for name in ABILITIES if name in self.takes)
                raise EvaluationError(
                    f"{whose}{self.name} takes no {option.replace('_', '-')}; it takes"
                    f" {takes or 'none'}, and options of its own: name{{option=value}}"
                )


_HERE = "me2e_compress.evaluators"

EVALUATORS: Registry[Evaluator] = Registry(
    "evaluator",
    _HERE,
    EvaluationError,
    {
        "highway": f"{_HERE}.highway.evaluator:Highway",
        "bench2drive": f"{_HERE}.bench2drive.real_results:Bench2DriveResults",
    },
)


def evaluator_named(text: str) -> Evaluator:
    """Build an evaluator from ``name{option=value}``, or raise EvaluationError."""
    return with_abilities(EVALUATORS.parse(text))


def with_abilities(evaluator: Evaluator) -> Evaluator:
    """Return the evaluator; an EvaluationError if it lacks what it declares."""
    name, cls = evaluator.name, type(evaluator)
    if not isinstance(evaluator, Evaluator):
        raise EvaluationError(
            f"evaluator {name!r} is a {cls.__name__}, which is no Evaluator: derive it "
            f"from {_HERE}.Evaluator"
        )
    for ability in sorted(evaluator.takes):
        if ability not in ABILITIES:
            raise EvaluationError(
                f"{name} declares {ability!r}, which nobody asks for; there are"
                f" {', '.join(ABILITIES)}"
            )
        for method in METHODS.get(ability, ()):
            if getattr(cls, method) is getattr(Evaluator, method):
                words = f"{name} declares {ability}, but has no {method}()"
                raise EvaluationError(words)
    return evaluator
