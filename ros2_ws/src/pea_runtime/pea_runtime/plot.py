"""Drawing without a screen: import `plt` from here, so that every figure shows text as text.

A dollar in a name begins no formula. Text of others goes through `pea_core.printable`.
"""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

plt.rcParams["text.parse_math"] = False

__all__ = ["plt"]
