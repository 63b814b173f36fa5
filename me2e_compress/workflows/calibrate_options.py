"""How ranges are measured or imported, and the files that this takes."""

import dataclasses
from pathlib import Path

from me2e_compress.calibration.exchange import TABLE_FILES
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.workflows.checks import MOST_THREADS, check_count


@dataclasses.dataclass(frozen=True)
class CalibrateOptions:
    """How ranges are measured or imported.

    Attributes:
        recipe: a shipped recipe or a TOML file; its passes before int8 are run.
        method: ``mse``, ``max-min`` or ``percentile:P``; None takes that of the
            recipe's int8, else ``mse``.
        count: number of frames, drawn in whole scenes.
        module_map: preset or TOML file; None finds the preset.
        imported: a TensorRT cache or onnxruntime table, instead of frames; frames given
            too only judge its scales.
        tensorrt_cache: write a TensorRT calibration cache too.
        onnxruntime_table: write onnxruntime's table too, into this folder.
        threads: threads of onnxruntime; 0 takes all.
        adapter: TOML file that says which outputs are fed back; give it to ``compress``
            too.
        provider: what runs the graph.
        force: replace outputs that we did not write, too.

    Raises:
        RecipeError: The method or a number is not valid.
    """

    recipe: str | Path = "exact"
    method: str | None = None
    count: int = 256
    module_map: str | Path | None = None
    imported: str | Path | None = None
    tensorrt_cache: str | Path | None = None
    onnxruntime_table: str | Path | None = None
    threads: int = 0
    adapter: str | Path | None = None
    provider: Provider = CPU
    force: bool = False

    def __post_init__(self) -> None:
        if self.method is not None:
            OBSERVERS.parse(self.method)
        check_count("--threads", self.threads, most=MOST_THREADS)


def checkpoint_beside(output: Path) -> Path:
    """Return where the progress of a calibration stands."""
    return output.with_name(output.name + ".checkpoint")


def overrides_beside(output: Path) -> Path:
    """Return where the overrides stand of what an imported cache lacks."""
    return output.with_name(f"{output.stem}.overrides.toml")


def written_files(output: Path, options: CalibrateOptions) -> list[Path]:
    """List the files that are written; an onnxruntime table is a folder of three."""
    files = [output, checkpoint_beside(output)]
    if options.imported is not None:
        files.append(overrides_beside(output))
    if options.tensorrt_cache is not None:
        files.append(Path(options.tensorrt_cache))
    if options.onnxruntime_table is not None:
        folder = Path(options.onnxruntime_table)
        if folder.is_dir():
            files += (folder / name for name in TABLE_FILES)
    return files
