"""The step of a block and of the loop, written once: compute, then commit.

Kernels of the loop, lanes of a sweep, compiled hops of nodes, replay, theory and emulated stages
compose these functions. Each of them adds only where signals come from, where they go, and when
a sample is due. `pea_core.block.Block` is the same step with a memory of its own.

Numba compiles this text as it stands, laid into the kernel that calls it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from pea_core.block import Model


class BlockStep(NamedTuple):
    """The step of one block, whatever its role.

    compute : ``compute(c, s, signals) -> output``. Pure.
    commit : ``commit(c, s, signals, output, realised) -> s``, with what came of the output.
    both : ``both(c, s, signals) -> output, s``, where nothing comes in between.

    `signals` and `realised` are tuples: (noise,) and (u,) of a plant, (measured,) and () of an
    observer, (W, W_ff, estimate) and () of a law.
    """

    compute: Callable[..., Any]
    commit: Callable[..., Any]
    both: Callable[..., Any]


def step_of(model: Model) -> BlockStep:
    """The step of a model (`pea_core.block`)."""
    output, update = model.output, model.update

    def compute(c: object, s: object, signals: tuple[Any, ...]) -> Any:
        return output(c, s, *signals)

    def commit(
        c: object, s: object, signals: tuple[Any, ...], out: object, realised: tuple[Any, ...]
    ) -> Any:
        return update(c, s, *signals, out, *realised)

    def both(c: object, s: object, signals: tuple[Any, ...]) -> Any:
        out = output(c, s, *signals)
        return out, update(c, s, *signals, out)

    return BlockStep(compute, commit, both)


class LoopStep(NamedTuple):
    """The step of plant, observer and law together; c and s hold theirs, in this order.

    compute : ``compute(c, s, noise, W, W_ff) -> measured, estimate, u``. Pure.
    commit : ``commit(c, s, noise, W, W_ff, measured, estimate, u) -> s``.
    """

    compute: Callable[..., Any]
    commit: Callable[..., Any]


def loop_step(plant: Model, observer: Model, law: Model) -> LoopStep:
    """Compose the step of a loop from those of its three models."""
    plant_computes, plant_commits = step_of(plant)[:2]
    observer_computes, observer_commits = step_of(observer)[:2]
    law_computes, law_commits = step_of(law)[:2]

    def compute(c: Any, s: Any, noise: float, W: Any, W_ff: Any) -> Any:
        measured = plant_computes(c[0], s[0], (noise,))
        estimate = observer_computes(c[1], s[1], (measured,))
        u = law_computes(c[2], s[2], (W, W_ff, estimate))
        return measured, estimate, u

    def commit(
        c: Any, s: Any, noise: float, W: Any, W_ff: Any, measured: Any, estimate: Any, u: float
    ) -> Any:
        s_p = plant_commits(c[0], s[0], (noise,), measured, (u,))
        s_o = observer_commits(c[1], s[1], (measured,), estimate, ())
        s_c = law_commits(c[2], s[2], (W, W_ff, estimate), u, ())
        return s_p, s_o, s_c

    return LoopStep(compute, commit)
