"""Studies that say only what differs from one that ships."""

from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.study import load_study
from me2e_compress.zoo.shipped import shipped
from tests.study.test_file import GOOD, write


def test_variants_that_name_no_policy_take_the_study_s(models: Path) -> None:
    text = GOOD.replace('policy = "slow.onnx"\n', "", 2)

    study = load_study(write(models, 'policy = "highway"\n' + text))

    ours = str(shipped("highway"))
    named = str(models / "slow.onnx")
    assert [each.policy for each in study.variants] == [ours, ours, named]


def test_a_study_like_one_that_ships_says_only_what_differs(models: Path) -> None:
    keys = 'like = "shifts"\npolicy = "slow.onnx"\nroutes = 3\ntitle = "Mine"\n'

    study, theirs = load_study(write(models, keys)), load_study("shifts")

    assert (study.title, len(study.routes)) == ("Mine", 3)
    assert {each.policy for each in study.variants} == {str(models / "slow.onnx")}
    assert (study.conditions, study.pairs) == (theirs.conditions, theirs.pairs)
    assert [each.name for each in study.variants] == [
        each.name for each in theirs.variants
    ]


@pytest.mark.parametrize("name", ["'gone'", "'../shipped/paper'", "3", "''"])
def test_a_study_like_none_that_ships_is_refused(models: Path, name: str) -> None:
    path = write(models, f"like = {name}\n{GOOD}")

    with pytest.raises(StudyError, match=r"^\S+study\.toml: like .*; we ship paper"):
        load_study(path)
