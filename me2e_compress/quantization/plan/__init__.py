"""The plan: for every node, int8 or float, by which rule, and why."""

from me2e_compress.quantization.plan.decision import (
    FLOAT,
    INT8,
    RESIDUAL,
    Decision,
    KeptFloat,
    QuantPlan,
    ScaleGroup,
)
from me2e_compress.quantization.plan.groups import (
    SharingCost,
    share_scales,
    sharing_costs,
)
from me2e_compress.quantization.plan.make import channel_axis, make_plan, tensors_of
from me2e_compress.quantization.plan.overrides import Overrides
from me2e_compress.quantization.plan.plan_files import (
    PlanDifference,
    differences,
    load_plan,
    plan_of,
    save_plan,
    stamp_plan,
)

__all__ = [
    "FLOAT",
    "INT8",
    "RESIDUAL",
    "Decision",
    "KeptFloat",
    "Overrides",
    "PlanDifference",
    "QuantPlan",
    "ScaleGroup",
    "SharingCost",
    "channel_axis",
    "differences",
    "load_plan",
    "make_plan",
    "plan_of",
    "save_plan",
    "share_scales",
    "sharing_costs",
    "stamp_plan",
    "tensors_of",
]
