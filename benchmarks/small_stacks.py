"""VAD and UniAD in small, with frames, for `benchmarks.written_files --stacks`.

    python -m benchmarks.small_stacks FOLDER

All classes, layers and edges of the published networks, with fewer pixels, cells and
queries; weights and frames are of seed 0. Each is NAME.onnx beside the folder NAME.
"""
