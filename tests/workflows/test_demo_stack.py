from pathlib import Path

from me2e_compress.runtime.interleaved import RunTimes
from me2e_compress.workflows.demo_stack import FilesResult


def test_the_demo_of_a_stack_ends_in_size_time_and_plan(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("stack.onnx", "exact.onnx", "small.onnx")]
    for path, size in zip(paths, (4_000_000, 3_900_000, 1_000_000), strict=True):
        path.write_bytes(bytes(size))
    times = {
        path: RunTimes((seconds,), (seconds,))
        for path, seconds in zip(paths, (2.0, 1.9, 1.5), strict=True)
    }

    lines = FilesResult(times, 2, 1, "small.onnx is yours.", "plan: 0.1 m").lines()

    assert lines[0] == "1.00 MB, 25% of 4.00; 1.50 s a frame, 0.75 of 2.00"
    assert lines[1] == "plan: 0.1 m"
    assert lines[-1] == "small.onnx is yours."
