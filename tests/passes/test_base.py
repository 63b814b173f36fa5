from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import onnx_ir as ir
import pytest

from me2e_compress.passes import Context, Pass, PassResult
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.passes.quantize_int8 import QuantizeInt8


@dataclass(frozen=True)
class Sample(Pass):
    """Does nothing.

    Given:   x
    Result:  x
    """

    name: ClassVar[str] = "sample"
    exact: ClassVar[bool] = True
    means: Path | None = None

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return PassResult(model, 0)


def test_files_are_the_paths_that_are_set() -> None:
    assert Sample().files() == ()
    assert Sample(means=Path("m.npz")).files() == (Path("m.npz"),)


@pytest.mark.parametrize(
    ("current", "needs"),
    [
        (Sample(), False),
        (AblateModules(drop=("occ",), fill="means"), True),
        (AblateModules(drop=("occ",), fill="means", means=Path("m.npz")), False),
        (QuantizeInt8(), True),
        (QuantizeInt8(ranges=Path("r.json")), False),
    ],
)
def test_frames_are_needed_where_nothing_else_is_given(
    current: Pass, needs: bool
) -> None:
    assert current.needs_frames is needs
