import re
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.base.errors import (
    EvaluationError,
    GraphError,
    ProviderError,
    RecipeError,
    StudyError,
)
from me2e_compress.manager import recipe
from me2e_compress.runtime.providers import CPU, CpuProvider
from me2e_compress.shipped.drivers import shipped_model
from me2e_compress.simulator.routes import load_routes, save_routes
from me2e_compress.study import Condition, load_study
from me2e_compress.study.definition import FramesToRecord, StudyBlock
from tests.evaluators.highway.drivers import CROSSING, PARKED
from tests.support.command import write_frames

GOOD = """
title = "Try"
baseline = "float"
routes = 3
held_out = "frames"

[latency]
samples = 50
baseline_median_s = 0.43

[[variant]]
name = "float"
policy = "slow.onnx"

[[variant]]
name = "small"
policy = "slow.onnx"
recipe = "exact"

[[variant]]
name = "mine"
policy = "slow.onnx"
passes = "import-normalize,fold-constants"

[[condition]]
name = "ideal"
latency = "none"
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


def test_everything_that_a_file_says(models: Path) -> None:
    study = load_study(write(models, GOOD))

    assert (study.title, study.baseline, study.seed) == ("Try", "float", 0)
    assert (len(study.routes), study.set_size) == (3, 220)
    assert study.timing.baseline_median_s == 0.43
    assert study.held_out == models / "frames"
    policies = [variant.policy for variant in study.variants]
    assert policies == [str(models / "slow.onnx")] * 3
    exact = recipe.load("exact")
    assert [len(variant.passes) for variant in study.variants] == [0, len(exact), 2]
    assert study.conditions == (Condition("ideal", "none"),)


def test_conditions_blocks_and_pairs_of_a_file(models: Path) -> None:
    parts = """
    [[condition]]
    name = "fog"
    latency = "fps:10"
    weather = "fog_m=60"
    dt_ms = 25

    [[condition]]
    name = "even"
    mean_of = "float.fog"
    latency_model = "fifo"

    [[block]]
    name = "table-3"
    variants = ["small"]
    conditions = ["fog", "even"]

    [[pair]]
    of = "float.fog"
    against = "small.ideal"
    """
    study = load_study(write(models, GOOD + parts))

    _, fog, even = study.conditions
    rest = {"dt_ms": 25.0}
    assert fog == Condition("fog", "fps:10", weather="fog_m=60", **rest)  # type: ignore[arg-type]
    assert even == Condition("even", mean_of="float.fog", latency_model="fifo")
    assert study.blocks == (StudyBlock("table-3", ("small",), ("fog", "even")),)
    assert study.pairs == (("float.fog", "small.ideal"),)


def test_files_lie_beside_the_study(models: Path, tmp_path: Path) -> None:
    save_routes((CROSSING, PARKED), tmp_path / "two.json")
    (tmp_path / "my.toml").write_text('[[pass]]\nname = "fold-constants"\n')
    (tmp_path / "slow.onnx").write_bytes((models / "slow.onnx").read_bytes())
    write_frames(tmp_path / "frames", command=np.array([3]))
    text = GOOD.replace("routes = 3", 'routes = "two.json"')

    study = load_study(write(tmp_path, text.replace('"exact"', '"my.toml"')))

    assert (study.routes, study.set_size) == ((CROSSING, PARKED), 2)
    assert [step.name for step in study.variants[1].passes] == ["fold-constants"]


def test_a_name_that_is_no_file_is_one_that_ships_whatever_is_where_you_are(
    models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = GOOD.replace('"slow.onnx"', '"highway"')
    (tmp_path / "highway").write_bytes((models / "slow.onnx").read_bytes())
    monkeypatch.chdir(tmp_path)

    study = load_study(write(models, text))

    assert study.variants[0].policy == str(shipped_model("highway"))


def test_a_file_where_you_are_is_not_beside_the_study(
    models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(models, GOOD.replace('"slow.onnx"', '"other.onnx"'))
    (tmp_path / "other.onnx").write_bytes((models / "slow.onnx").read_bytes())
    monkeypatch.chdir(tmp_path)

    with pytest.raises(GraphError, match=r"^other\.onnx: no such file; models"):
        load_study(path)


def test_libraries_of_the_study_and_of_its_provider(models: Path) -> None:
    for name in ("beside.so", "other.so"):
        (models / name).touch()
    other = models / "other.so"
    keys = f'provider = "cpu{{plugins=[{other}]}}"\nplugins = ["beside.so"]\n'

    study = load_study(write(models, keys + GOOD), trust_code=True)

    libraries = (other, models / "beside.so")
    assert study.provider == CpuProvider(plugins=libraries)
    assert set(libraries) <= set(study.inputs())


def test_provider_and_routes_of_the_command_line_win(models: Path) -> None:
    path = write(models, 'provider = "npu"\n' + GOOD)

    study = load_study(path, provider="cpu", routes="ParkedObstacle_R2_0")
    assert study.provider == CPU
    assert [route.id for route in study.routes] == ["ParkedObstacle_R2_0"]
    with pytest.raises(ProviderError, match="no provider 'npu'; there are cpu, cuda"):
        load_study(path)


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        ("title =", "titel =", StudyError, "no key titel"),
        ("[latency]", "[timing]", StudyError, "no key timing"),
        ("samples", "sample", StudyError, r"no key latency\.sample"),
        ("routes = 3", "seed = -1", StudyError, "seed: Input should be greater than"),
        ("median_s = 0.43", "median_s = 0.0", StudyError, r"latency\.base.* than 0"),
        (
            "[latency]",
            "[record]\nframes = 0\nheld_out = 4\n[latency]",
            StudyError,
            r"record\.frames: Input should be greater than or equal to 1",
        ),
        ("small", 'small"\nrecip = "exact', StudyError, r"no key variant\.1\.recip"),
        (
            'latency = "none"',
            'latency = "none"\nlimit_fps = 5',
            StudyError,
            r"no key \S+\.limit_fps",
        ),
        ('baseline = "float"', "", StudyError, "baseline: Field required"),
        ('policy = "slow.onnx"', "", StudyError, "float: neither it nor the study nam"),
        ("routes = 3", "routes = 1.5", StudyError, "routes"),
        ("routes = 3", "routes = 0", EvaluationError, "0 routes were asked for"),
        ("routes = 3", 'routes = "no"', EvaluationError, "no route 'no'"),
        ('recipe = "exact"', 'recipe = "exakt"', RecipeError, "no recipe exakt"),
        ("fold-constants", "fold-constant", RecipeError, "no pass 'fold-constant'"),
        ("passes", 'recipe = "full"\npasses', StudyError, "a recipe or passes, not"),
        ('"slow.onnx"\nrecipe', '"quick"\nrecipe', GraphError, "quick: no such file"),
        ('latency = "none"', 'latency = "quick"', EvaluationError, "source 'quick'"),
        ("[latency]", "[latency", StudyError, "not TOML"),
        (
            "[latency]",
            "[record]\nframes = 4\nheld_out = 4\n[latency]",
            StudyError,
            "folders of frames, or what to record, not both",
        ),
    ],
)
def test_what_is_wrong_is_one_line(
    models: Path, old: str, new: str, error: type[Exception], message: str
) -> None:
    assert old in GOOD
    path = write(models, GOOD.replace(old, new))

    with pytest.raises(error, match=message) as caught:
        load_study(path)
    assert "\n" not in str(caught.value)


def test_no_study_ships() -> None:
    with pytest.raises(StudyError, match=r"^no study paper: no such file$"):
        load_study("paper")


def test_variants_that_name_no_policy_take_the_study_s_and_drive_every_route(
    models: Path,
) -> None:
    text = GOOD.replace('policy = "slow.onnx"\n', "", 2).replace("routes = 3", "")

    study = load_study(write(models, 'policy = "highway"\n' + text))

    ours = str(shipped_model("highway"))
    named = str(models / "slow.onnx")
    assert [variant.policy for variant in study.variants] == [ours, ours, named]
    assert study.routes == load_routes()


def test_the_study_of_the_documents_is_one(tmp_path: Path) -> None:
    page = Path(__file__).parents[2] / "docs" / "study.md"
    blocks = re.findall(r"```toml\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
    whole, *parts = blocks

    for name in ("frames", "held-out"):
        write_frames(tmp_path / name, command=np.array([3]))

    study = load_study(write(tmp_path, whole))

    assert [variant.name for variant in study.variants] == ["float", "int8"]
    assert study.conditions[1].traced

    folders = re.compile(r"^(frames|held_out) = .*$", re.MULTILINE)
    ours = [part for part in parts if "[[pair]]" not in part]
    of_parts = load_study(write(tmp_path, "\n".join((folders.sub("", whole), *ours))))

    assert [block.name for block in of_parts.blocks] == ["table-3"]
    assert of_parts.to_record == FramesToRecord(256, 64)
