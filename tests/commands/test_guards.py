"""What is refused from Python as it is on the command line, before any work."""

from collections.abc import Callable

import pytest

import me2e_compress as me2e
from me2e_compress.base.errors import RecipeError


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: me2e.CompressOptions(verify_frames=-1), "-frames is -1"),
        (lambda: me2e.CalibrateOptions(method="max"), "method 'max'"),
        (lambda: me2e.SearchOptions(), "give a budget"),
        (lambda: me2e.SearchOptions(max_ms=float("nan")), "is nan"),
        (lambda: me2e.SensitivityOptions(limit=-1.0), "--limit is -1"),
        (lambda: me2e.ProfileOptions(samples=10**20), "--samples is 1"),
        (lambda: me2e.ProfileOptions(threads=10**9), "1,024 at most"),
        (lambda: me2e.LintOptions(target="onnxruntime", trt_check=True), "trt"),
    ],
)
def test_options_are_checked_once_when_they_are_made(
    make: Callable[[], object], message: str
) -> None:
    with pytest.raises(RecipeError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
