"""Whatever a study runs, it runs on its provider."""

import json
from pathlib import Path

import pytest

from me2e_compress.runtime.profile import describe_machine
from me2e_compress.runtime.providers import CpuProvider
from me2e_compress.study import Study, Timing, run_study
from tests.study.conftest import IDEAL, ROUTES, Here, Make


@pytest.fixture
def asked(make: Make, tmp_path: Path) -> Study:
    """Two models on one route, with a library of operators."""
    library = tmp_path / "operators.so"
    library.touch()
    return make(
        variants=make().variants[1:3],
        conditions=(IDEAL,),
        routes=ROUTES[:1],
        timing=Timing(1),
        provider=CpuProvider(plugins=(library,)),
    )


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, ...]]:
    """The libraries of every session that is opened; none is loaded."""
    found: list[tuple[Path, ...]] = []
    monkeypatch.setattr(
        CpuProvider, "attach", lambda self, options: found.append(self.plugins)
    )
    return found


def test_every_session_of_a_study_is_on_its_provider(
    asked: Study, opened: list[tuple[Path, ...]], tmp_path: Path
) -> None:
    folder = tmp_path / "out"

    result = run_study(asked, folder, Here(), pictures=0)

    assert set(opened) == {asked.provider.plugins}
    (trace,) = (folder / "traces").glob("slow*")
    machine = describe_machine(1, asked.provider)
    assert json.loads(trace.read_text())["machine"] == machine
    assert "operators.so" in machine
    assert "operators.so" in result.to_json()["provider"]
