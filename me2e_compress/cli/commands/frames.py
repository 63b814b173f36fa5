"""``me2e-compress frames``."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.calibration.recording import write_recording
from me2e_compress.cli.console import console, progress
from me2e_compress.cli.extras import need_closed_loop
from me2e_compress.cli.models import model_path
from me2e_compress.cli.output import check_folder
from me2e_compress.runtime.frames import Frame
from me2e_compress.zoo.stacks import STACKS, find
from me2e_compress.zoo.synthetic_frames import frames as synthetic

SCENE_LENGTH = 8
"""Frames of a synthetic scene, half a second apart."""
DRIVEN_SCENE_LENGTH = 16
"""Frames of a stretch of a route, half a second apart."""


def frames(
    stack: Annotated[str, typer.Argument(help="vad-tiny, highway or M.onnx")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the folder")],
    count: Annotated[int, typer.Option("-n", "--count", help="how many")] = 256,
    scene_length: Annotated[
        int | None,
        typer.Option(
            help=f"frames a scene; default {SCENE_LENGTH} for vad-tiny, else"
            f" {DRIVEN_SCENE_LENGTH}"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="of the scenes")] = 0,
) -> None:
    """Write calibration frames, coherent in time, seen by six cameras.

    For vad-tiny a synthetic world is drawn; for highway, or any ONNX file that
    keeps the policy contract, the expert drives fresh routes of highway-env.
    """
    check_folder(output, (stack,))
    with progress("frames") as advance:
        record(
            stack,
            output,
            count,
            seed,
            scene_length,
            lambda done: advance(done, count, stack),
        )
    console.print(f"{output}: {count} frames of {stack}, seed {seed}")


def record(
    stack: str,
    folder: Path,
    count: int,
    seed: int,
    scene_length: int | None = None,
    on_frame: Callable[[int], None] = lambda done: None,
) -> Path:
    """Make frames of a stack or model and write them, all or nothing.

    Args:
        stack: A stack of the zoo, or an ONNX file that keeps the policy contract.
        folder: To write.
        count: Frames.
        seed: Of everything.
        scene_length: Frames a scene; None for the default of the kind.
        on_frame: Told the number of frames made, after each.

    Returns:
        The folder.

    Raises:
        GraphError: No such stack and no such file, or altered weights.
        FramesError: A count below 1, or the folder holds something else.
        EvaluationError: The file does not keep the policy contract.
        MissingExtraError: Driving needs the extra ``highway``.
    """
    if Path(stack).is_file() or find(stack).trained:
        length = DRIVEN_SCENE_LENGTH if scene_length is None else scene_length
        made = _driven(model_path(stack), count, seed, length)
    else:
        length = SCENE_LENGTH if scene_length is None else scene_length
        made = _synthetic(stack, count, seed, length)
    about: dict[str, str | int] = {"stack": stack, "seed": seed}
    return write_recording(folder, _told(made, on_frame), about)


def _driven(model: Path, count: int, seed: int, length: int) -> Iterator[Frame]:
    need_closed_loop("what frames of a driver need")
    from me2e_compress.evaluators.highway.driven_frames import driven_frames
    from me2e_compress.evaluators.highway.onnx_policy import OnnxPolicy

    policy = OnnxPolicy.open(model)
    return driven_frames(policy, count, seed=seed, scene_length=length)


def _synthetic(stack: str, count: int, seed: int, length: int) -> Iterator[Frame]:
    made = synthetic(STACKS[stack], count, seed, length)
    for index, arrays in enumerate(made):
        yield Frame(index, index % length == 0, dict(arrays))


def _told(made: Iterator[Frame], on_frame: Callable[[int], None]) -> Iterator[Frame]:
    for frame in made:
        yield frame
        on_frame(frame.index + 1)
