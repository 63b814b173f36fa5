"""A VAD-tiny that is ready to run."""

from me2e_compress.errors import GraphError
from me2e_compress.zoo.vad.config import HEADS, HeadsName, Sampling
from me2e_compress.zoo.vad.initialise import initialise
from me2e_compress.zoo.vad.stack import VadTiny


def build(
    *, seed: int = 0, heads: HeadsName = "nuscenes", sampling: Sampling = "operator"
) -> VadTiny:
    """Build and initialise; the same seed gives the same bytes.

    Raises:
        GraphError: There are no heads of that name.
    """
    if heads not in HEADS:
        raise GraphError(f"no heads {heads!r}: there is {', '.join(HEADS)}")
    model = VadTiny(heads, sampling).requires_grad_(False).eval()
    initialise(model, seed)
    return model
