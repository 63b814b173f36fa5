"""VAD, UniAD and TCP in small, with frames, for `written_files --stacks`.

    python -m benchmarks.subjects.small_stacks FOLDER

All classes, layers and edges of the published networks, with fewer pixels, cells and
queries; weights and frames are of seed 0, TCP's frames noise. Each is NAME.onnx beside
the folder NAME.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from models.export import save, trace
from models.synthetic_frames import frames
from models.tests.tcp.small import small_spec as tcp_spec
from models.tests.tcp.small import small_tcp
from models.tests.uniad.small import small_frames, small_spec, small_uniad
from models.tests.vad.sizes import SIZES
from tests.support.frames import record

OPSET = 17


def main() -> None:
    """Write the stacks and four frames of each, in scenes of two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)

    vad, uniad = SIZES["small"], small_spec()
    vad.export(folder / "vad-small.onnx")
    drawn = list(frames(vad.stack, 4, seed=0, scene_length=2))
    record(folder / "vad-small", drawn, (0, 2))
    graph = trace(uniad, small_uniad(), OPSET)
    save(graph, uniad.metadata(), folder / "uniad-small.onnx")
    record(folder / "uniad-small", small_frames(4), (0, 2))
    tcp, noise = tcp_spec("bench2drive"), np.random.default_rng(0)
    graph = trace(tcp, small_tcp("bench2drive"), OPSET)
    save(graph, tcp.metadata(), folder / "tcp-small.onnx")
    shapes = tcp.inputs.items()
    drawn = [
        {name: noise.standard_normal(shape, np.float32) for name, shape in shapes}
        for _ in range(4)
    ]
    record(folder / "tcp-small", drawn, (0, 2))


if __name__ == "__main__":
    main()
