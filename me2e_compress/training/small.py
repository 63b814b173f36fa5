"""The whole way in small: it learns nothing, but every part of it runs."""

from dataclasses import replace

from me2e_compress.driving.latency import FixedLatency
from me2e_compress.training.curriculum import Course, Round, Trial
from me2e_compress.training.data import Sequences
from me2e_compress.training.process import Training
from me2e_compress.zoo.highway.config import HighwayConfig

_FEW = ("ControlLoss", "DynamicObjectCrossing", "HighwayCutIn")
_BRIEF = Training(
    steps=4,
    batch=1,
    workers=2,
    save_every=2,
    check_every=2,
    check_count=2,
    sequences=Sequences(length=2),
)
_AGAIN = replace(_BRIEF, steps=2, seed=1)
_PLANNER = replace(_BRIEF, steps=2, seed=2, modules=("planner",))
SMALL = Course(
    (
        Round(100, 1, 1.0, (_BRIEF,), _FEW),
        Round(200, 1, 0.8, (_AGAIN, _PLANNER), _FEW[2:], repeat=2),
    ),
    Trial(routes=2, scenarios=_FEW[:2]),
    HighwayConfig(stages=(8, 8, 16, 16), anchors=16),
)
"""A minute on two cores. Who has learned nothing stands or creeps until the rules end
the route, after 60 to 200 s: hence the expert drives most of the second round."""
LATENCY = FixedLatency(1_000_000)
"""Of a decision in its trials, for the same reason: 200 are enough to get nowhere."""
