"""Everything this package raises on purpose.

Every message says what was found, what there is, and names the culprit, on one line.
"""

__all__ = [
    "BrokenPackageError",
    "EnergyError",
    "EvaluationError",
    "FramesError",
    "GraphError",
    "Me2eError",
    "MissingExtraError",
    "ModuleMapError",
    "PassError",
    "PreconditionError",
    "RecipeError",
    "StudyError",
    "VerificationError",
]

_USE = "is gone since 0.3.0: use"
_FORMER = {
    "calibration method entropy": f"entropy {_USE} mse",
    "calibration method moving-average": f"moving-average {_USE} max-min",
    "quantize-int8 weight_only_gemv": f"weight_only_gemv {_USE} "
    "rules=safe{without=[gemv]}",
    "quantize-int8 without": f"without {_USE} rules=safe{{without=[gemv]}}",
    "quantize-int8 attention_limit": f"attention_limit {_USE} rules=NAME{{...}}",
    "convert-float16 keep_io": "keep_io is gone since 0.3.0: inputs stay float32",
    **{
        f"convert-float16 {name}": f"{name} {_USE} keep, globs over all three"
        for name in ("keep_ops", "keep_modules", "keep_nodes")
    },
    "ablate-modules means": f"means {_USE} frames (--frames)",
    "fuse-basic swish": "swish is gone since 0.3.0: onnxruntime has no kernel",
    **{
        f"fuse-operators {option}": f"{option} is gone since 0.3.0: it has one value"
        for option in ("tolerance", "merge_images")
    },
    "eliminate-redundant across_modules": "across_modules is gone since 0.3.0",
    "fold-constants growth": f"growth {_USE} bytes_per_node",
    "command build": f"build {_USE} trtexec --onnx=M.onnx --saveEngine=M.engine",
    "command ranges": f"ranges {_USE} calibrate, which says what deserves a look",
    "dump json": f"no .npz: JSON of other tools {_USE} docs/engine-dumps.md",
    "--weight-only-gemv": f"--weight-only-gemv {_USE} --rules 'safe{{without=[gemv]}}'",
    "--no-remedy": "--no-remedy is gone since 0.3.0: compress searches no nodes",
    "driving log nuscenes": f"nuscenes {_USE} examples/driving_logs",
    "driving log bench2drive": f"bench2drive {_USE} examples/driving_logs",
    "--shard": f"--shard {_USE} one run, which goes on where it was killed",
    "--merge": f"--merge {_USE} one run, which goes on where it was killed",
    "rule set tensorrt": f"tensorrt {_USE} safe",
    "tensorrt machine": "machine is gone since 0.3.0: measure on the board",
    "study scheme": f"[[scheme]] {_USE} [[variant]]",
    "stack first_frame": f"first_frame {_USE} a TOML of its own for the first frames",
    "stack first": f"first {_USE} [recurrent] of the adapter",
    "--on-road": f"search --on-road {_USE} a study that names the schemes",
    "--most-ablated": f"--most-ablated {_USE} a study that names the schemes",
    "--baseline-median-s": f"--baseline-median-s {_USE} a study's key of that name",
    "--records": f"study --records {_USE} python -m benchmarks.paper",
    "--weigh": f"study --weigh {_USE} python -m benchmarks.paper",
    "--plugins": f"--plugins {_USE} --provider 'cpu{{plugins=[LIB.so]}}'",
    "--set-dim": f"--set-dim {_USE} compress M.onnx -r exact --set-dim DIM=N -o"
    " FIXED.onnx, and FIXED.onnx here",
    "sensitivity --drive": f"sensitivity --drive {_USE} a study of the recipes",
    "sensitivity --workers": f"sensitivity --workers {_USE} a study of the recipes",
    "--drive-limit": f"--drive-limit {_USE} a study of the recipes",
    "--latency-scale": f"--latency-scale {_USE} --latency 'trace{{trace=F,scale=2}}'",
    "--in-order": f"--in-order {_USE} --latency 'trace{{trace=FILE,in_order=true}}'",
    "--latency-model": f"--latency-model {_USE} a study's latency_model",
    "--dt-ms": f"--dt-ms {_USE} a study's dt_ms",
    "--frame-limit": "--frame-limit is gone since 0.3.0: a decision may take 60 s",
    "--drive-on": "--drive-on is gone since 0.3.0: a collision ends the route",
    "--host-stage": f"--host-stage {_USE} the policy 'onnx{{path=F,host_stage=NAME}}'",
    "--smaller": f"--smaller {_USE} a recipe's fold-constants{{bytes_per_node=0}}",
    "--allow-empty": f"--allow-empty {_USE} -r exact, which writes no int8",
    "compress --alive": "--alive is of compare alone since 0.3.0",
    "command routes": f"routes {_USE} python -m benchmarks.tools.admit_routes",
    "--tactic-source": "--tactic-source is gone since 0.3.0: TensorRT chooses",
    "--seed": "--seed is of compress, evaluate and frames since 0.3.0",
    "--tensorrt-cache": f"--tensorrt-cache {_USE} compress: int8 pairs have the scales",
    "--onnxruntime-table": f"--onnxruntime-table {_USE} compress, whose file is int8",
    "--against": f"--against {_USE} plan -o for both, and compare the two files",
    "--save-weights": f"score --save-weights {_USE} one call that names all folders",
    "score --weights": f"--weights {_USE} one call that names all folders",
    "--unproven": f"--unproven {_USE} --verify-frames 0, which asks for no proof",
    "--threads": "--threads is of calibrate and profile since 0.3.0",
    "--energy-out": f"--energy-out {_USE} TRACE.energy.json beside the trace",
    "inspect --frames": f"inspect --frames {_USE} profile --by-module",
    "inspect --trace": f"inspect --trace {_USE} profile --by-module",
    "--figure": f"--figure {_USE} --by-module, which prints each module's share",
    "--nodes": f"--nodes {_USE} plan -v",
    "study paper": f"the study paper {_USE} benchmarks/paper/paper.toml",
    "study shifts": f"the study shifts {_USE} benchmarks/shifts.toml",
    "study tail": f"the study tail {_USE} benchmarks/tail.toml",
    "study like": f"like {_USE} a study with keys of its own",
    "study questions": f"questions {_USE} benchmarks/paper/questions.toml",
    "study report": f"report {_USE} python -m benchmarks.paper of its folder",
    "latency source agents": f"agents {_USE} examples/third_party",
    "energy counter rapl": f"rapl {_USE} examples/energy_counters",
    "energy counter ina3221": f"ina3221 {_USE} examples/energy_counters",
    "--modelled-energy": f"--modelled-energy {_USE} the MACs and MB of `inspect`",
    "--junctions": "--junctions is gone since 0.3.0: such routes are not judged",
    "--abilities": "--abilities is gone since 0.3.0: the rules are those of 0.0.4",
    "--penalties": "--penalties is gone since 0.3.0: they are Bench2Drive's",
    "--modelled": f"--modelled {_USE} --joules, measured",
    **{
        f"stack {name}": f"{name} {_USE} a file: python -m models.export {name}; its"
        f" frames: python -m models.frames {name}"
        for name in ("vad-tiny", "uniad-tiny", "uniad-trt", "tcp")
    },
    **{
        f"export {name}": f"{name} {_USE} python -m models.export"
        for name in ("--opset", "--heads", "--seed", "--dialect", "--weights", "--ema")
    },
    **{
        f"adapter tcp-{name}": f"tcp-{name} {_USE} models.tcp.policy"
        for name in ("control", "fusion", "beta-control", "beta-fusion")
    },
    "adapter key control": f"controls of a graph {_USE} a policy in Python",
    "demo --stack": f"--stack {_USE} python -m models.export",
    **{
        f"demo {option}": f"demo {option} {_USE} compress, compare and a study"
        for option in ("-r", "--recipe", "--routes", "--workers", "--provider")
    },
    "--road": "--road is gone since 0.3.0: there is one road, with traffic",
    "study condition.against": f"against {_USE} [[pair]]",
    "study condition.in_order": f"in_order {_USE} latency = 'trace{{in_order=true}}'",
    "study condition.seed": f"a condition's seed {_USE} latency = 'trace{{seed=3}}'",
    "study condition.limit_fps": f"limit_fps {_USE} 'limited{{source=trace,fps=10}}'",
    "study road": "the key road is gone since 0.3.0: there is one road, with traffic",
    "study record.road": "the key road is gone since 0.3.0: there is one road",
    "model expert": f"expert {_USE} models.driver.expert:Expert",
    "model blind": f"blind {_USE} models.driver.expert:Blind",
    "policy highway-2": f"highway-2 {_USE} highway",
    "model highway-2": f"highway-2 {_USE} highway",
    "pass static-geometry": f"static-geometry {_USE} freeze-inputs, with --frames",
}
_NOT_INSTALLED = ("benchmarks", "docs/", "examples/", "models.")
FORMER_NAMES = {
    name: line + ", in the repository" * any(each in line for each in _NOT_INSTALLED)
    for name, line in _FORMER.items()
}
"""Messages on names of 0.2 by kind and name; to be deleted with 0.4.0."""


def cites_old_name(error: BaseException) -> bool:
    """Return whether an error is about a name of 0.2 that the user still writes."""
    message = str(error)
    return any(line in message for line in FORMER_NAMES.values())


class Me2eError(Exception):
    """Base class: the command line prints these on one line, without a traceback."""


class GraphError(Me2eError):
    """A file is not a graph we can read, or lacks something we need."""


class ProviderError(Me2eError):
    """An execution provider or a library of operators is missing."""


class FramesError(Me2eError):
    """Calibration frames are missing, of another model, or not finite."""


class ModuleMapError(Me2eError):
    """A module map is malformed, or one of its patterns matches nothing."""


class RecipeError(Me2eError):
    """A recipe or pipeline names an unknown pass or option."""


class OptionError(RecipeError):
    """An option is missing or takes no such value: a usage error."""


class PreconditionError(Me2eError):
    """A pass was given a graph it cannot work on."""


class PassError(Me2eError):
    """A pass broke; the cause is chained."""


class VerificationError(Me2eError):
    """The graph after a pass is not a valid successor of the one before."""


class EnergyError(Me2eError):
    """A counter of energy, or a file of one, is not usable."""


class EvaluationError(Me2eError):
    """A route, a policy or a folder of results is not usable."""


class StudyError(Me2eError):
    """A study is malformed, or names what it does not have."""


class MissingExtraError(Me2eError):
    """An optional package is not installed; the message says which extra brings it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(package, extra)  # both: pickle makes it of its arguments

    def __str__(self) -> str:
        """Return the line that says what to install."""
        package, extra = self.args
        return f"{package} is not installed: pip install 'me2e-compress[{extra}]'"


class BrokenPackageError(Me2eError):
    """An optional package is installed, and importing it fails."""

    def __init__(self, package: str, extra: str, reason: str) -> None:
        super().__init__(package, extra, reason)

    def __str__(self) -> str:
        """Return the line that says why, and what to install again."""
        package, extra, reason = self.args
        return (
            f"{package} is installed, but cannot be imported: {reason}: pip install"
            f" --force-reinstall 'me2e-compress[{extra}]'"
        )
