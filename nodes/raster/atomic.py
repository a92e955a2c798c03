"""The counter from which the threads of a frame take their work."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def _fetch_add(_context: Any, counter: Any, amount: Any) -> Any:
    """Atomically add ``amount`` to ``counter[0]`` ((1,) int64) and return what it was."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0])
        return builder.atomic_rmw("add", array.data, arguments[1], "monotonic")

    return types.int64(counter, types.int64), codegen


fetch_add: Any = intrinsic(_fetch_add)
