"""How compiled code compiles what it calls: as text of its caller, not as a function of its own.

Numba makes machine code of every function that a kernel calls, with an entry for the interpreter,
and optimises it again in each caller. Nobody but the kernel calls them: here they are laid into
it, and the kernel is optimised once, as a whole. It is compiled in a third of the time; and
coefficients and states, which are nested tuples, need not be handed over, which takes longer than
the arithmetic.

It imports numba: imported where something is compiled.
"""

# mypy: disable-error-code="misc,untyped-decorator"

from __future__ import annotations

import atexit
import threading
from typing import Any

from llvmlite.binding.ffi import register_lock_callback  # type: ignore[import-untyped]
from numba import _dynfunc, version_info
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import NativeLowering

KNOWN = ((0, 68),)
"""Versions of numba whose inner names this follows."""


_llvm = threading.RLock()
"""Held by the thread that LLVM works for."""

register_lock_callback(_llvm.acquire, _llvm.release)
# The end of a process takes LLVM's memory away: another thread that compiles would crash it. So it
# waits for what LLVM is at, a second or so, and lets nobody begin anew.
atexit.register(_llvm.acquire)


class _Text(JITCodeLibrary):
    """Instructions that are linked into a caller, as they were written."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        """Leave that to the kernel."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _WriteDown(NativeLowering):
    """Write down the instructions, and let callers know them."""

    _name = "pea_callee"

    def run_pass(self, state: Any) -> bool:
        state.library = _Text(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        state.flags.no_compile = True
        super().run_pass(state)
        described = state.cr.fndesc
        key = _dynfunc.make_function(  # numba asks for one of this type; it has no address
            described.lookup_module(),
            described.qualname.rpartition(".")[2],
            "called by compiled code alone",
            0,
            state.cr.env,
            (state.library,),
        )
        state.targetctx.insert_user_function(key, described, [state.library])
        state.reload_init.extend(state.library._reload_init)
        state["cr"] = state.cr._replace(cfunc=key)
        return True


class Callee(Compiler):
    """Numba's compiler for what kernels call (``pipeline_class`` of ``numba.jit``)."""

    def define_pipelines(self) -> list[PassManager]:
        """See `numba.core.compiler.CompilerBase`."""
        pipeline = PassManager(self.__class__.__name__)
        for each, said in super().define_pipelines()[0].passes:
            pipeline.add_pass(_WriteDown if each is NativeLowering else each, said)
        pipeline.finalize()
        return [pipeline]


def options() -> dict[str, Any]:
    """Of ``numba.jit``, for what kernels call.

    A numba that is not `KNOWN` compiles every function by itself: the same bits, later.
    """
    laid_in = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return laid_in | ({"pipeline_class": Callee} if version_info.short in KNOWN else {})
