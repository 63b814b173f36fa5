"""An evaluation as plain options."""

from pathlib import Path

import pytest

from me2e_compress.driving.latency import FrameRate
from me2e_compress.errors import EvaluationError, ProviderError
from me2e_compress.evaluators import EVALUATORS
from me2e_compress.evaluators.highway.evaluator import HighwayEvaluation
from me2e_compress.simulator.routes import save_routes
from tests.evaluators.highway.drivers import EXIT


def test_an_evaluation_is_its_text(tmp_path: Path) -> None:
    save_routes([EXIT], tmp_path / "routes.json")
    options = f'folder="{tmp_path}/out", routes="{tmp_path}/routes.json"'
    evaluator = EVALUATORS.parse(f"highway{{policy=blind:9, {options}}}")

    (episode,) = evaluator.episodes()

    assert EVALUATORS.parse(EVALUATORS.text(evaluator)) == evaluator
    assert episode.route == "exit"
    assert (tmp_path / "out" / "routes" / "exit.json").is_file()


def test_options_reach_the_drive(tmp_path: Path) -> None:
    conditions = (
        HighwayEvaluation(
            "blind", tmp_path, latency="fps:5", dt_ms=25, weather="night=0.5"
        )
        .evaluator()
        .job.conditions
    )

    assert conditions.latency == FrameRate(5.0)
    assert conditions.dt_us == 25_000
    assert conditions.weather.night == 0.5


def test_the_model_runs_on_its_provider(tmp_path: Path) -> None:
    model = tmp_path / "m.onnx"
    model.touch()

    with pytest.raises(ProviderError, match="no provider 'npu'; there are cpu, cuda"):
        EVALUATORS.parse(
            f'highway{{policy="{model}", folder="{tmp_path}", provider=npu}}'
        )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("policy=expert:3", "expert takes no value"),
        ("policy=m.onnx", "policy m.onnx: no such file, and no policy of that name"),
        ("policy=blind, routes=nowhere", "no route 'nowhere'"),
        ("policy=blind, latency=slow", "no latency source 'slow'"),
        ("policy=blind, weather=hail=1", "a comma or } is expected"),
        ('policy=blind, weather="hail=1"', "weather option 'hail': there are fog_m"),
        ("policy=blind, dt_ms=1e308", r"a step of 1e\+308 ms: it must divide 50 ms"),
        ("policy=blind, dt_ms=nan", "a step of nan ms"),
        ("policy=blind, engine=cloud", "engine 'cloud' with address None"),
        ("policy=blind, address=here", "engine 'local' with address here"),
        ("routes=all", "highway needs the option policy"),
    ],
)
def test_a_wrong_option_is_named_before_anything_drives(
    tmp_path: Path, options: str, message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        list(EVALUATORS.parse(f'highway{{folder="{tmp_path}", {options}}}').episodes())
    assert not list(tmp_path.iterdir())
