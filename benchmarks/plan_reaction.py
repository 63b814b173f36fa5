"""Measure whether the plan depends on what a camera sees."""

import numpy as np

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.plan_adapter import PlanAdapter
from me2e_compress.runtime.session import Session, replay


def plan_reaction(
    session: Session, frame: Frame, other: Frame, *, image: str = "img", camera: int = 0
) -> float:
    """Return how far the plan moves when one camera's image is exchanged.

    A network whose plan ignores its cameras scores perfectly in every comparison; this
    detects it. Camera ``camera`` of the input ``image``, [1, cameras, 3, H, W], shows
    the image of ``other`` instead; the recurrent state starts from zeros. The result is
    |plan' - plan| / |plan|, Euclidean over all waypoints.

    Raises:
        EvaluationError: the model has no plan, or the frame no such camera.
    """
    adapter = PlanAdapter.of(session.metadata, list(session.outputs))
    if adapter is None:
        raise EvaluationError("the model does not say which output is its plan")
    # the same frame, with one image exchanged
    changed = {**frame.arrays, image: _exchanged(frame, other, image, camera)}
    needed = [adapter.output, *([adapter.scores] if adapter.scores else [])]
    plans = [
        adapter.plan(values, arrays)
        for arrays in (frame.arrays, changed)
        for values in replay(session, [Frame(0, True, arrays)], needed)
    ]
    # relative to the plan's own length
    length = float(np.linalg.norm(plans[0]))
    gap = float(np.linalg.norm(plans[1] - plans[0]))
    return gap / length if length else (float("inf") if gap else 0.0)


def _exchanged(frame: Frame, other: Frame, image: str, camera: int) -> Array:
    if image not in frame.arrays or image not in other.arrays:
        raise EvaluationError(
            f"the frame has no input {image}; it has {', '.join(frame.arrays)}"
        )
    images = frame.arrays[image].copy()
    if images.ndim != 5 or not 0 <= camera < images.shape[1]:
        raise EvaluationError(
            f"{image} has shape {list(images.shape)}: no camera {camera} in it"
        )
    images[:, camera] = other.arrays[image][:, camera]
    return images
