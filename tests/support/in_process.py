"""Routes that are driven in the process of the test, which need not start first."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import pytest

from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.contract import Driven
from me2e_compress.simulator.routes import Route


@dataclass
class Here:
    """Drives in this process, and writes down what."""

    driven: list[tuple[str, str]] = field(default_factory=list)

    def drive(
        self, policy: Driver, drive: Drive, routes: Sequence[Route]
    ) -> Iterator[Driven]:
        # highway-env takes a second to import: only who drives needs it
        from me2e_compress.evaluators.highway import runner

        for route in routes:
            self.driven.append((policy.label, route.id))
            yield Driven(runner.drive(route, policy.open(), drive), 0.0, 0)


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Here:
    """Let routes that processes of this machine would drive be driven here."""
    here = Here()
    engine = "me2e_compress.evaluators.highway.engine.LocalEngine.drive"
    monkeypatch.setattr(engine, lambda self, *words: here.drive(*words))
    return here


@pytest.fixture
def short(here: Here, monkeypatch: pytest.MonkeyPatch) -> Here:
    """The same, a second of each route: for who asks whether it drives, not how."""
    runner = "me2e_compress.evaluators.highway.runner"
    monkeypatch.setattr(f"{runner}.TIMEOUT_US", 1_000_000)
    return here
