"""Readers of a dropped module read the mean of what it made."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import FramesError, PreconditionError
from me2e_compress.graph import provenance
from me2e_compress.passes.ablate_modules import AblateModules
from tests.frames import record
from tests.nets import net
from tests.passes.ablated import NO_MAP, SIZED, STACK, context, plan_of, substitute
from tests.passes.small import ops


@pytest.fixture
def recording(tmp_path: Path) -> CalibrationSet:
    """Two cameras; agents (their magnitude where positive) average 1, 0, 3, 6."""
    cameras = ([[2, 0, 2, 3]], [[-2, 0, 4, 9]])
    frames = [{"camera": np.array(camera, np.float32)} for camera in cameras]
    return CalibrationSet(record(tmp_path / "frames", frames))


def test_readers_read_the_mean_over_the_frames(recording: CalibrationSet) -> None:
    chosen = AblateModules(drop=("agents",), fill="means")

    result = chosen.run(net(STACK, {}), replace(context(), frames=recording))

    met = np.sqrt(np.array([1, 0, 3, 6], "f"))
    alone = np.exp(np.array([0, 0, -4, -9], "f"))
    np.testing.assert_allclose(plan_of(result.model), met + alone, rtol=1e-6)
    assert "agents reads as its mean over 2 frames" in result.notes
    assert "Abs" not in ops(result.model)
    assert not provenance.missing(result.model)


def test_means_leave_substitutes_aside(recording: CalibrationSet) -> None:
    chosen = AblateModules(drop=("map",), fill="means", drop_outputs=True)
    substitutes = context(substitute("*.look", "*.meet"))

    result = chosen.run(net(STACK, {}), replace(substitutes, frames=recording))

    seen = np.exp(-np.array([1, 0, 3, 6], "f"))
    met = np.sqrt(np.array([0, 0, 4, 9], "f"))
    np.testing.assert_allclose(plan_of(result.model), seen + met, rtol=1e-6)
    assert result.removed_outputs == ("lanes",)


def test_means_from_a_file_go_before_frames(
    recording: CalibrationSet, tmp_path: Path
) -> None:
    file = tmp_path / "means.npz"
    np.savez(file, agents=np.array([[4, 9, 16, 25]], np.float32))
    chosen = AblateModules(drop=("agents",), fill="means", means=file)

    result = chosen.run(net(STACK, {}), replace(context(), frames=recording))

    expected = np.exp(np.array([0, 0, -4, -9], "f")) + np.array([2, 3, 4, 5], "f")
    np.testing.assert_allclose(plan_of(result.model), expected, rtol=1e-6)
    assert f"agents reads as its mean in {file}" in result.notes


@pytest.mark.parametrize(
    ("name", "array", "error", "words"),
    [
        ("boxes", np.zeros((1, 4), "f"), FramesError, "no mean of agents; .* boxes"),
        (
            "agents",
            np.zeros((1, 5), "f"),
            PreconditionError,
            r"float32 \[1, 5\] cannot stand for agents, which is float32 \[1, 4\]",
        ),
        (
            "agents",
            np.zeros((1, 4), "d"),
            PreconditionError,
            "a constant float64 .* agents, which is float32",
        ),
    ],
)
def test_means_of_another_graph(
    tmp_path: Path,
    name: str,
    array: np.ndarray,
    error: type[Exception],
    words: str,
) -> None:
    file = tmp_path / "means.npz"
    np.savez(file, **{name: array})  # type: ignore[arg-type]
    chosen = AblateModules(drop=("agents",), fill="means", means=file)

    with pytest.raises(error, match=words):
        chosen.run(net(STACK, {}), context())


def test_shapes_have_no_mean(recording: CalibrationSet) -> None:
    with pytest.raises(PreconditionError, match="size is arithmetic on shapes"):
        replace(NO_MAP, fill="means").run(
            net(SIZED, {}), replace(context(), frames=recording)
        )
