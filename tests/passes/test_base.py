from pathlib import Path

import pytest

from me2e_compress.passes import Pass
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from tests.test_recipes import Sample


def test_files_are_the_paths_that_are_set() -> None:
    assert Sample().files() == ()
    assert Sample(means=Path("m.npz")).files() == (Path("m.npz"),)


@pytest.mark.parametrize(
    ("current", "needs"),
    [
        (Sample(), False),
        (AblateModules(drop=("occ",), fill="means"), True),
        (AblateModules(drop=("occ",)), False),
        (QuantizeInt8(), True),
        (QuantizeInt8(ranges=Path("r.json")), False),
    ],
)
def test_which_passes_need_frames(current: Pass, needs: bool) -> None:
    assert current.needs_frames is needs
