"""What the sliding mode laws share: switching function q and the control that holds it.

e_1 = x_1 - w and e_2 = x_2 - w' (Eq 5).
"""

from pea_core.signals import Estimate, Reference


def switching_function(m: float, W: Reference, x: Estimate) -> float:
    """Eq 9, q = m e_1 + e_2 (m/s)."""
    return m * (x.x1 - W.w) + (x.x2 - W.w_dot)


def equivalent_control(
    A21: float, A22: float, B2: float, m: float, W: Reference, x: Estimate
) -> float:
    """Eq 12 without u_3, -B_2^{-1} (m e_2 + A21 e_1 + A22 e_2) in volts: q' = B_2 (u_3 + eps)."""
    e1 = x.x1 - W.w
    e2 = x.x2 - W.w_dot
    return -(m * e2 + A21 * e1 + A22 * e2) / B2
