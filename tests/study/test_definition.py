from pathlib import Path

import pytest

from me2e_compress.errors import Me2eError, StudyError
from me2e_compress.manager import recipe
from me2e_compress.passes import Pass
from me2e_compress.study import Condition, Timing, Variant
from tests.study.conftest import IDEAL, Make


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variants": ()}, "the study has no variant"),
        ({"conditions": ()}, "the study has no condition"),
        ({"conditions": (IDEAL, IDEAL)}, "2 conditions are named ideal"),
        ({"baseline": "quick"}, "'quick' is not a variant; there are blind, slow"),
        ({"routes": ()}, "no route to drive"),
        ({"seed": -1}, "seed -1: must be 0 or more"),
        (
            {"pairs": (("slow.ideal", "slow.fog"),)},
            r"pair: 'slow.fog' is no VARIANT.CONDITION",
        ),
        (
            {"conditions": (Condition("device", "trace"),), "held_out": None},
            "condition device: the latency of slow is measured on held-out frames",
        ),
    ],
)
def test_a_study_that_could_not_be_finished(
    make: Make, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(StudyError, match=message):
        make(**changes).check()


@pytest.mark.parametrize(
    ("passes", "name"),
    [
        (recipe.load("feature-ext"), "quantize-int8"),
        (recipe.load("minus-occ"), "ablate-modules"),
    ],
)
def test_passes_that_need_frames_and_none_are_given(
    make: Make, passes: tuple[Pass, ...], name: str
) -> None:
    words = rf"variant small: {name} measures on recorded frames, and there are none"
    with pytest.raises(StudyError, match=words):
        make(variants=(Variant("small", "m.onnx", passes),), baseline="small")


@pytest.mark.parametrize(
    "text",
    [
        "quantize-int8{ranges=r.json}",
        "ablate-modules{drop=[occ]}",
        "ablate-modules{drop=[occ],fill=means,means=m.npz}",
        "lower-int8",
    ],
)
def test_passes_that_need_no_frames(make: Make, text: str) -> None:
    variants = (Variant("small", "m.onnx", recipe.parse(text)),)

    assert make(variants=variants, baseline="small").frames is None


@pytest.mark.parametrize("name", ["", "a b", "../up", "a/b", ".hidden", "a.b"])
def test_a_name_that_is_no_folder(name: str) -> None:
    with pytest.raises(StudyError, match="a name is made of letters"):
        Variant(name, "expert")


@pytest.mark.parametrize(
    "options",
    [
        {"passes": recipe.load("exact")},
        {"adapter": Path("a.toml")},
        {"trace": Path("t.json")},
        {"module_map": "vad"},
    ],
)
def test_a_driver_that_is_no_model_takes_nothing(options: dict[str, object]) -> None:
    with pytest.raises(StudyError, match="variant e: expert is not a model"):
        Variant("e", "expert", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "numbers", [(0, 1, None), (1, 0, None), (1, 1, 0.0), (1, 1, float("nan"))]
)
def test_a_timing_that_measures_nothing(numbers: tuple[int, int, float | None]) -> None:
    with pytest.raises(Me2eError, match="latency: "):
        Timing(*numbers)
