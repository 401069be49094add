r"""The observer matching condition: rank(C B) = rank(B).

Only when it holds does a classical unknown-input observer exist. Displacement feedback of the
second-order model gives C B = 0 and misses it; the sampled plant meets it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold, state_space


class Matching(NamedTuple):
    """Ranks of C B and B in continuous time, and C B_d (m/V) of the sampled model."""

    rank_CB: int
    rank_B: int
    CB_d: float

    @property
    def holds(self) -> bool:
        """Whether rank(C B) = rank(B)."""
        return self.rank_CB == self.rank_B

    def __str__(self) -> str:
        text = f"observer matching condition: rank(CB) = {self.rank_CB}, rank(B) = {self.rank_B}"
        if self.holds:
            return text + ": met, a classical unknown-input observer exists"
        return (
            text + ": not met, no classical unknown-input observer exists for displacement "
            f"feedback; the sampled plant has C B_d = {self.CB_d * 1e6:.3e} um/V, so eps has "
            "to be estimated by other means"
        )


def matching(model: NominalModel, T_s: float) -> Matching:
    """Test the condition for `model` sampled every T_s (s)."""
    A, B, C = state_space(model)
    _, B_d = hold(A, B, T_s)
    rank = np.linalg.matrix_rank
    return Matching(int(rank(C @ B)), int(rank(B)), float((C @ B_d)[0, 0]))
