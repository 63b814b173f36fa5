import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import StudyError
from me2e_compress.base.listener import SILENT
from me2e_compress.manager import PassManager, recipe
from me2e_compress.study import Listener, Study, Variant
from me2e_compress.study.prepared import PreparedVariant, prepare_variant
from me2e_compress.study.workspace import Workspace
from tests.evaluators.highway.drivers import slow_here, straight_on
from tests.study.conftest import Make
from tests.support.command import write_frames
from tests.support.stand_in import write_model


@pytest.fixture
def study(make: Make, tmp_path: Path) -> Study:
    """One variant that takes a module of a small stack away."""
    write_model(tmp_path / "m.onnx")
    write_images(tmp_path / "frames", 0)
    variant = Variant("minus-occ", str(tmp_path / "m.onnx"), recipe.load("minus-occ"))
    return make(variants=(variant,), baseline="minus-occ", frames=tmp_path / "frames")


def write_images(folder: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    write_frames(
        folder,
        img=random.normal(size=(1, 6, 3, 16, 24)).astype(np.float32),
        lidar2img=random.normal(size=(1, 6, 4, 4)).astype(np.float32),
        can_bus=random.normal(size=18).astype(np.float32),
        command=np.array([3]),
        timestamp=np.array([0.0], np.float32),
    )


def made(study: Study, folder: Path) -> PreparedVariant:
    return prepare_variant(study, study.variants[0], Workspace(folder), SILENT)


def test_passes_make_a_model_of_their_own(study: Study, tmp_path: Path) -> None:
    source = Path(study.variants[0].policy)
    before = source.read_bytes()

    result = made(study, tmp_path)

    assert result.model is not None
    assert result.model.parent == tmp_path / "models"
    assert result.sha256 == graph.sha256_of(result.model)
    assert result.size_bytes == result.model.stat().st_size
    assert "ablate-modules" in result.pipeline
    outputs = graph.load(result.model).graph.outputs
    assert "occupancy" not in [output.name for output in outputs]
    assert source.read_bytes() == before


def test_the_checkpoint_of_a_model_is_kept(study: Study, tmp_path: Path) -> None:
    source = Path(study.variants[0].policy)
    model = graph.load(source)
    model.metadata_props["me2e.weights"] = "a.pth"
    graph.save(model, source)
    plain = dataclasses.replace(study, variants=(Variant("minus-occ", str(source)),))

    assert made(plain, tmp_path).weights == "a.pth"


@pytest.mark.parametrize("change", ["frames", "source", "passes", "seed", "adapter"])
def test_what_decides_the_model_decides_its_name(
    study: Study, tmp_path: Path, change: str
) -> None:
    first, variant = made(study, tmp_path), study.variants[0]
    (tmp_path / "a.toml").write_text("")
    write_images(tmp_path / "others", 1)
    if change == "source":
        write_model(tmp_path / "m.onnx", seed=1)
    elif change == "adapter":
        variant = dataclasses.replace(variant, adapter=tmp_path / "a.toml")
    elif change == "passes":
        variant = dataclasses.replace(variant, passes=recipe.load("minus-map"))
    else:
        values = {"frames": tmp_path / "others", "seed": 1}
        study = dataclasses.replace(study, **{change: values[change]})  # type: ignore[arg-type]
    study = dataclasses.replace(study, variants=(variant,))

    assert made(study, tmp_path).model != first.model


@pytest.mark.parametrize("damage", ["", "weights", "cut", "report", "no report"])
def test_the_same_is_made_once_and_an_altered_model_again(
    study: Study, tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*_: object) -> None:
        raise AssertionError("the passes ran again")

    warnings = list[str]()
    first = made(study, tmp_path)
    assert first.model is not None
    report = first.model.with_name(f"{first.model.stem}.report.json")
    if not damage:
        monkeypatch.setattr(PassManager, "run", run)
    elif damage == "weights":
        write_model(first.model, seed=3)
    elif damage == "cut":
        first.model.write_bytes(first.model.read_bytes()[:-9])
    elif damage == "report":
        report.write_text("{}")
    else:
        report.unlink()

    listener = Listener(on_warning=warnings.append)
    again = prepare_variant(study, study.variants[0], Workspace(tmp_path), listener)

    assert again == first
    assert graph.sha256_of(first.model) == first.sha256
    assert json.loads(report.read_text())["output"]["sha256"] == first.sha256
    repeated = [warning for warning in warnings if "made again" in warning]
    sentences = [f"{first.model}: not what its report is of: made again"]
    assert repeated == ([] if damage in ("", "no report") else sentences)


def with_overrides(study: Study, file: Path) -> Study:
    passes = recipe.parse(f'quantize-int8{{overrides="{file}"}}')
    variant = dataclasses.replace(study.variants[0], passes=passes)
    return dataclasses.replace(study, variants=(variant,), baseline=variant.name)


def test_a_file_that_a_pass_reads_decides_the_model(
    study: Study, tmp_path: Path
) -> None:
    file = tmp_path / "overrides.toml"
    asked = with_overrides(study, file)
    file.write_text("")
    first = made(asked, tmp_path)
    assert made(asked, tmp_path) == first

    file.write_text('[[override]]\nnodes = "/neck/MatMul"\ndtype = "int8"\n')
    second = made(asked, tmp_path)

    assert second.model != first.model
    assert second.sha256 != first.sha256


def test_a_file_that_a_pass_reads_and_that_is_gone(
    study: Study, tmp_path: Path
) -> None:
    asked = with_overrides(study, tmp_path / "gone.toml")

    words = r"minus-occ: \S+gone\.toml: cannot be read: No"
    with pytest.raises(StudyError, match=words):
        made(asked, tmp_path)


def test_what_made_a_file_is_read_from_the_report_beside_it(
    study: Study, tmp_path: Path
) -> None:
    first = made(study, tmp_path)
    assert first.model is not None
    variants = (Variant("minus-occ", str(first.model)),)
    plain = dataclasses.replace(study, variants=variants)

    result = made(plain, tmp_path)

    assert (result.source, result.pipeline) == ("m.onnx", first.pipeline)
    write_model(first.model, seed=3)
    assert made(plain, tmp_path).pipeline == ""


def test_a_variant_in_tensorrts_form_is_warned_of(make: Make, tmp_path: Path) -> None:
    slow_here(tmp_path / "slow.onnx")
    straight_on(tmp_path / "float.onnx")
    variants = tuple(
        Variant(name, str(tmp_path / f"{name}.onnx")) for name in ("float", "slow")
    )
    study, messages = make(variants=variants, baseline="float"), list[str]()
    listener = dataclasses.replace(SILENT, on_warning=messages.append)

    for variant in variants:
        prepare_variant(study, variant, Workspace(tmp_path), listener)

    (warning,) = messages
    assert warning.startswith("variant slow: it is quantized in TensorRT's form")
