"""Fold constants with onnxsim, in a separate process."""

import dataclasses
import subprocess
import tempfile
from pathlib import Path

import onnx_ir as ir

from me2e_compress.base.errors import PassError
from me2e_compress.graph import digest, load, node_count, save
from me2e_compress.graph.digest import digest_of_tensor
from me2e_compress.graph.rewrite import lift_constants, sweep
from me2e_compress.graph.surgeon import restore
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.runtime.children import run_script

__all__ = ["FoldWithOnnxsim"]

_OWN_METADATA = "onnxsim."

# Not imported here: onnxsim imports torch where that is installed.
_WORKER = Path(__file__).with_name("onnxsim_main.py")


@dataclasses.dataclass(frozen=True)
class FoldWithOnnxsim(Pass):
    """Fold constants with onnxsim (its optimizer off) in a separate process.

    onnxsim is native code: a crash or an endless loop ends only that process. Modules,
    origins and names, which it drops, are restored; its own entries in the model's
    metadata are removed.

    Given:
        s = Shape(w)  ;  y = Reshape(x, s)      with w a weight

    Result:
        y = Reshape(x, [2, 3])

    Attributes:
        timeout_s: seconds that onnxsim may take.
    """

    name = "fold-with-onnxsim"
    exact = True

    timeout_s: float = 600.0

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Fold a copy; a crash, refusal or timeout of onnxsim is a PassError."""
        # Exchange the model through files
        with tempfile.TemporaryDirectory(prefix="me2e-onnxsim-") as folder:
            source, folded = Path(folder, "source.onnx"), Path(folder, "folded.onnx")
            save(model, source)
            _simplify(source, folded, self.timeout_s)
            result = load(folded)
            _own_weights(result, model)
        # Restore what onnxsim drops and remove what it adds
        for key in [key for key in result.metadata_props if _OWN_METADATA in key]:
            del result.metadata_props[key]
        restore(result, model, by=self.name, node_names=True)
        lift_constants(result)
        sweep(result)
        result.producer_name = model.producer_name
        result.producer_version = model.producer_version
        if digest(result) == digest(model):
            return PassResult(model, 0)
        return PassResult(result, max(1, node_count(model) - node_count(result)))


def _simplify(source: Path, folded: Path, timeout_s: float) -> None:
    try:
        run_script(_WORKER, (str(source), str(folded)), timeout_s).check_returncode()
    except subprocess.TimeoutExpired as error:
        message = f"fold-with-onnxsim: onnxsim took longer than {timeout_s:g} s"
        raise PassError(message) from error
    except subprocess.CalledProcessError as error:
        code, lines = error.returncode, str(error.stderr).split("\n")
        last = next((line.strip() for line in lines[::-1] if line.strip()), "nothing")
        end = f"ended with code {code} and said: {last}"
        end = f"was killed by signal {-code}" if code < 0 else end
        raise PassError(f"fold-with-onnxsim: onnxsim {end}") from error


def _own_weights(result: ir.Model, model: ir.Model) -> None:
    """Read the weights: those of the model where they are equal, others from disk."""
    ours = model.graph.initializers
    for graph in (result.graph, *result.graph.subgraphs()):
        for name, value in graph.initializers.items():
            tensor = value.const_value
            known = ours[name].const_value if name in ours else None
            digests = [digest_of_tensor(t) for t in (tensor, known) if t is not None]
            if len(digests) == 2 and digests[0] == digests[1]:
                value.const_value = known
            elif isinstance(tensor, ir.ExternalTensor):
                array = tensor.numpy().copy()
                value.const_value = ir.Tensor(array, dtype=tensor.dtype, name=name)
