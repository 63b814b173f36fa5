"""Write frames of a synthetic world for a reference stack.

python -m models.frames vad-tiny -o DIR -n 6
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from me2e_compress.base.errors import Me2eError
from me2e_compress.calibration.recording import Begin, partial_folder, write_recording
from me2e_compress.commands.checks import check_folder, writing
from me2e_compress.commands.options import check_count
from me2e_compress.runtime.frames import Frame
from me2e_compress.version import __version__
from models.stacks import STACKS, find
from models.synthetic_frames import frames

SCENE_LENGTH = 8
"""Frames of a scene, half a second apart."""


def record(
    stack: str,
    folder: Path,
    count: int = 256,
    *,
    seed: int = 0,
    scene_length: int = SCENE_LENGTH,
    force: bool = False,
) -> Path:
    """Draw a world and write what a stack sees of it, all or nothing.

    A run that was killed goes on after its last whole scene. The folder is returned.

    Raises:
        GraphError: There is no such stack.
        FramesError: A count is below 1, or the folder holds something else.
    """
    spec = find(stack)
    check_count("--seed", seed)
    check_folder(folder, ())

    def drawn(begin: Begin) -> Iterator[Frame]:
        made = frames(spec, count, seed, scene_length, begin.frame)
        for index, arrays in enumerate(made, begin.frame):
            yield Frame(index, index % scene_length == 0, dict(arrays))

    about: dict[str, str | int] = {"stack": stack, "seed": seed}
    key = f"{__version__} {stack} {count} {scene_length}"
    with writing(trees=[folder], folders=[partial_folder(folder)], force=force):
        return write_recording(folder, drawn, about, key)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m models.frames")
    add = parser.add_argument
    add("stack", help=", ".join(STACKS))
    add("-o", "--output", type=Path, required=True, help="the folder")
    add("-n", "--count", type=int, default=256, help="number of frames")
    add("--scene-length", type=int, default=SCENE_LENGTH, help="frames a scene")
    add("--seed", type=int, default=0, help="of everything random")
    add("--force", action="store_true", help="replace what is there")
    given = parser.parse_args()
    try:
        folder = record(
            given.stack,
            given.output,
            given.count,
            seed=given.seed,
            scene_length=given.scene_length,
            force=given.force,
        )
    except Me2eError as error:
        sys.exit(f"models.frames: {error}")
    print(f"{folder}: {given.count} frames of {given.stack}, seed {given.seed}")


if __name__ == "__main__":
    main()
