"""CRITIC weights: a criterion weighs more the more it varies, independently of others.

Diakoulaki, Mavrotas and Papayannakis, Determining objective weights in multiple
criteria problems: the CRITIC method (1995), in the paper's form (equations 10 and 11).
"""

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EvaluationError

Floats = npt.NDArray[np.float64]

FLAT = 1e-12
"""A column whose standard deviation is below this share of its values is constant."""

ALIKE = 1e-9
"""Below this share, all criteria are redundant."""


def critic_weights(rows: Floats) -> Floats:
    """Return [m] weights of m criteria, which add up to 1.

    Equation 10: c_i = sigma_i * sum over j of (1 - abs(r_ij)); equation 11: w_i = c_i /
    sum of c. Sigma is the population's standard deviation (the sample's gives the same
    weights), r is Pearson's. The sign of a criterion does not matter. A constant
    criterion has weight 0 and is left out of the sums of the others.

    Example: the columns (0, 0, 1, 1), (0, 1, 1, 1) and (0, 1, 0, 1) have sigma 1/2,
    sqrt(3) / 4 and 1/2; r is 1 / sqrt(3) between the middle one and each other, and 0
    between those two. So c is (2 - 1 / sqrt(3)) / 2 = 0.711, (sqrt(3) - 1) / 2 = 0.366
    and 0.711, and the weights are 0.398, 0.205 and 0.398.

    Args:
        rows: [n, m] finite, normalized values, one row per observation.

    Raises:
        EvaluationError: All criteria but one are constant, or all are redundant.
    """
    # constant criteria are left out
    spread = rows.std(axis=0)
    varies = spread > FLAT * np.abs(rows).max(axis=0, initial=0.0)
    content = np.zeros(rows.shape[1])
    if varies.sum() > 1:
        correlation = np.atleast_2d(np.corrcoef(rows[:, varies], rowvar=False))
        apart = np.clip(1.0 - np.abs(correlation), 0.0, 1.0)
        content[varies] = spread[varies] * apart.sum(axis=1)
    # fully correlated criteria give no weights
    total = float(content.sum())
    if total <= ALIKE * float(spread.sum()) or not varies.any():
        raise EvaluationError(
            f"CRITIC finds no weights: of {rows.shape[1]} measures over {len(rows)} "
            f"rows {int(varies.sum())} vary, and none tells what another does not"
        )
    return content / total
