"""The bits of a tag: how many are set, and sums of a vertex and the translations that they name, one after the other.

``expand_tag`` is what pools are drawn with. Naming one bit after the other costs more than the matrix product that the
sum replaces (measured: 1.2 ns a point of 2.5), so where the processor can permute eight floats a tag is taken a byte at
a time: a table tells which of eight translations the byte names, and all of its sums are one permutation, one addition
and one store for each coordinate, whatever the byte is. ``expand_tag_plain`` is for other processors, and the readable
twin.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from ...shared.codecs.pools import TAG_BITS

_LANES = 8
SLACK = _LANES
"""Floats that are written behind the last sum; what is written there is no sum."""

_STEPS = 4
"""Bits that are taken without asking whether one is left: a branch a point would be mispredicted too often (measured:
1.2 times the time of drawing)."""

_ONE, _BYTE = np.uint32(1), np.uint32(0xFF)

_PLACES = np.zeros((256, _LANES), np.int32)
"""Which bits of each byte are set, the lowest first; then zeros."""
for _byte in range(256):
    _set = [_bit for _bit in range(8) if _byte >> _bit & 1]
    _PLACES[_byte, : len(_set)] = _set


def _lowest_bit_intrinsic(_context: Any, word: Any) -> Any:
    """Index of the lowest bit that is set in a uint32, 32 for none."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.cttz(arguments[0], cgutils.false_bit), ir.IntType(64))

    return types.uint64(types.uint32), codegen


_lowest_bit: Any = intrinsic(_lowest_bit_intrinsic)


def _count_bits_intrinsic(_context: Any, word: Any) -> Any:
    """How many bits are set in a uint32."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.ctpop(arguments[0]), ir.IntType(64))

    return types.int64(types.uint32), codegen


count_bits: Any = intrinsic(_count_bits_intrinsic)


def _put_eight_intrinsic(
    _context: Any, value: Any, source: Any, at: Any, places: Any, byte: Any, out: Any, n: Any
) -> Any:
    """``out[n : n + 8] = value + source[at : at + 8][places[byte]]``, floats and int32. AVX2."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        index, floats = ir.VectorType(ir.IntType(32), _LANES), ir.VectorType(ir.FloatType(), _LANES)

        def pointer(argument: int, place: Any, vector: Any) -> Any:
            array = cgutils.create_struct_proxy(signature.args[argument])(context, builder, arguments[argument])
            return builder.bitcast(builder.gep(array.data, [place]), vector.as_pointer())

        value, _, at, _, byte, _, n = arguments
        which = builder.load(pointer(3, builder.mul(byte, byte.type(_LANES)), index), align=4)
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(floats, [floats, index]), "llvm.x86.avx2.permps"
        )
        named = builder.call(function, [builder.load(pointer(1, at, floats), align=4), which])
        none = ir.Constant(floats, ir.Undefined)
        first = builder.insert_element(none, value, ir.IntType(32)(0))
        every = builder.shuffle_vector(first, none, ir.Constant(index, None))
        builder.store(builder.fadd(every, named), pointer(5, n, floats), align=4)
        return context.get_dummy_value()

    i, f = types.int64, types.float32
    return types.void(f, source, i, places, i, out, i), codegen


_put_eight: Any = intrinsic(_put_eight_intrinsic)


@njit(nogil=True, cache=True)
def expand_tag_plain(bits, x, y, w, dx, dy, dw, at, xs, ys, ws, n):
    """Write a point for each bit that is set from ``xs[n]``, ``ys[n]``, ``ws[n]`` on; return where they end.

    bits : uint32.  x, y, w : float32, the vertex.  dx, dy, dw : float32 arrays, translations; bit 0 is the one at
    ``at``, and there are at least ``TAG_BITS`` from there on.  xs, ys, ws : float32, ``SLACK`` longer than what is
    written.
    """
    end = n + count_bits(bits)
    while n < end:
        for k in range(_STEPS):  # where no bit is left a sum is written that the next one overwrites
            t = np.uintp(at) + (_lowest_bit(bits) & np.uintp(TAG_BITS - 1))
            bits &= np.uint32(bits - _ONE)
            i = np.uintp(n) + np.uintp(k)
            xs[i], ys[i], ws[i] = x + dx[t], y + dy[t], w + dw[t]
        n += _STEPS
    return end


@njit(nogil=True, cache=True)
def expand_tag_by_bytes(bits, x, y, w, dx, dy, dw, at, xs, ys, ws, n):
    """As ``expand_tag_plain``, on a processor that has AVX2."""
    for first in range(0, TAG_BITS, _LANES):
        byte = np.uint32(bits >> np.uint32(first)) & _BYTE
        _put_eight(x, dx, at + first, _PLACES, byte, xs, n)
        _put_eight(y, dy, at + first, _PLACES, byte, ys, n)
        _put_eight(w, dw, at + first, _PLACES, byte, ws, n)
        n += count_bits(byte)
    return n


def has_avx2() -> bool:
    """Whether numba compiles for a processor that has it."""
    context: Any = cpu_target.target_context
    return "+avx2" in context.codegen().magic_tuple()[2].split(",")


expand_tag: Any = expand_tag_by_bytes if has_avx2() else expand_tag_plain
