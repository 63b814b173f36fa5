"""The plan: for every node, int8 or float, by which rule, and why."""

from me2e_compress.quantization.plan.decision import (
    FLOAT,
    INT8,
    RESIDUAL,
    Decision,
    KeptFloat,
    PlanDifference,
    QuantPlan,
    ScaleGroup,
    differences,
    load_plan,
    plan_of,
    record,
    save_plan,
    stamp_plan,
)
from me2e_compress.quantization.plan.make import (
    SharingCost,
    make_plan,
    share_scales,
    sharing_costs,
    tensors_of,
)
from me2e_compress.quantization.plan.overrides import Overrides

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
    "differences",
    "load_plan",
    "make_plan",
    "plan_of",
    "record",
    "save_plan",
    "share_scales",
    "sharing_costs",
    "stamp_plan",
    "tensors_of",
]
