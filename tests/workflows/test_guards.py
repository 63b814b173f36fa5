"""What is refused from Python as it is on the command line, before any work."""

from collections.abc import Callable

import pytest

import me2e_compress as me2e
from me2e_compress.errors import Me2eError, RecipeError


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: me2e.CompressOptions(verify_frames=-1), RecipeError, "-frames is -1"),
        (lambda: me2e.CalibrateOptions(threads=-2), RecipeError, "--threads is -2"),
        (lambda: me2e.CalibrateOptions(method="max"), RecipeError, "method 'max'"),
        (lambda: me2e.SearchOptions(), RecipeError, "give a budget"),
        (lambda: me2e.SearchOptions(max_ms=float("nan")), RecipeError, "is nan"),
        (lambda: me2e.SensitivityOptions(limit=-1.0), RecipeError, "--limit is -1"),
        (lambda: me2e.ProfileOptions(samples=10**20), RecipeError, "--samples is 1"),
        (lambda: me2e.ProfileOptions(threads=10**9), RecipeError, "1,024 at most"),
        (lambda: me2e.CalibrateOptions(threads=10**9), RecipeError, "1,024 at most"),
        (
            lambda: me2e.LintOptions(target="onnxruntime", trt_check=True),
            RecipeError,
            "trt",
        ),
    ],
)
def test_options_are_checked_once_when_they_are_made(
    make: Callable[[], object], error: type[Me2eError], message: str
) -> None:
    with pytest.raises(error, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
