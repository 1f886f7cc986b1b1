"""Linear interpolation at equally spaced positions, eight at a time, as explicit SIMD.

Row edges lie evenly along a line of voxels. Eight neighbours of them read at most 8 (16) knots when they lie less than
one (two) knots apart: these are loaded whole and picked in registers, where AVX2 has a permutation for it. Elsewhere,
and for larger steps, each pair of knots is loaded on its own. The arithmetic is the same.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from torchpcct.projector.cpu.simd import _Code

__all__ = ["read_even"]

# Eight positions at most this far apart fall on 8, or on 16, neighbouring knots.
_STEP_OF_8, _STEP_OF_16 = 0.999, 2.13


@intrinsic
def read_even(typingctx, lanes, line, zeta0, step, last, size, read, count):
    """``read[i]`` = ``line`` interpolated at ``zeta0 + step * i`` clamped to the knots 0…last, for i < count.

    ``lanes``: tuple of the vector's length W. ``size``: elements of ``line``, > last. ``count``: a multiple of W.
    """
    signature = types.void(lanes, line, zeta0, step, last, size, read, count)

    def codegen(context, builder, signature, args):
        c = _Code(context, builder, signature, args)
        _, line, zeta0, step, last, size, read, count = c.values
        positions = _Positions(c, zeta0, step, last)

        def run(pick: Any) -> None:
            with cgutils.for_range(builder, builder.sdiv(count, ir.Constant(c.index, c.width))) as loop:
                first = c.times(loop.index, c.width)
                k, part = positions.at(first)
                low, high = pick(k)
                c.store(c.add(low, c.mul(part, c.sub(high, low))), read, first)

        def one_by_one(k: Any) -> tuple[Any, Any]:
            pair = ir.VectorType(c.real, 2)
            low = high = ir.Constant(c.wide, ir.Undefined)
            for i in range(c.width):
                place = ir.Constant(ir.IntType(32), i)
                both = c.load(line, builder.sext(builder.extract_element(k, place), c.index), pair)
                for j in range(2):
                    value = builder.extract_element(both, ir.Constant(ir.IntType(32), j))
                    if j:
                        high = builder.insert_element(high, value, place)
                    else:
                        low = builder.insert_element(low, value, place)
            return low, high

        features = context.codegen().magic_tuple()[2]
        if c.width != 8 or c.dtype != types.float32 or "+avx2" not in features.split(","):
            run(one_by_one)
            return context.get_dummy_value()
        fits = [
            builder.and_(
                builder.fcmp_ordered("<=", step, ir.Constant(c.real, limit)),
                builder.icmp_signed(">", size, ir.Constant(c.index, knots)),
            )
            for limit, knots in ((_STEP_OF_8, 8), (_STEP_OF_16, 16))
        ]
        with builder.if_else(fits[0]) as (then, otherwise):
            with then:
                run(lambda k: _pick(c, line, size, k, 1))
            with otherwise, builder.if_else(fits[1]) as (wide, rest):
                with wide:
                    run(lambda k: _pick(c, line, size, k, 2))
                with rest:
                    run(one_by_one)
        return context.get_dummy_value()

    return signature, codegen


class _Positions:
    """Lower knots and what the positions exceed them by."""

    def __init__(self, c: Any, zeta0: Any, step: Any, last: Any) -> None:
        self.c, self.integers = c, ir.VectorType(ir.IntType(32), c.width)
        self.zeta0, self.step = c.splat(zeta0, c.width), c.splat(step, c.width)
        self.top = c.splat(c.b.sitofp(last, c.real), c.width)
        highest = c.b.sub(c.b.trunc(last, ir.IntType(32)), ir.Constant(ir.IntType(32), 1))
        self.highest = c.splat(highest, c.width)
        self.steps = ir.Constant(c.wide, [ir.Constant(c.real, float(i)) for i in range(c.width)])

    def at(self, first: Any) -> tuple[Any, Any]:
        c = self.c
        i = c.add(c.splat(c.b.sitofp(first, c.real), c.width), self.steps)
        zeta = c.clamp(c.add(self.zeta0, c.mul(self.step, i)), self.top)
        k = c.b.fptosi(zeta, self.integers)
        k = c.b.select(c.b.icmp_signed("<", k, self.highest), k, self.highest)
        return k, c.sub(zeta, c.b.sitofp(k, c.wide))


def _pick(c: Any, line: Any, size: Any, k: Any, vectors: int) -> tuple[Any, Any]:
    """Knots ``k`` and ``k + 1`` out of ``vectors`` registers of 8 knots that begin at the first."""
    kind = ir.FunctionType(c.wide, [c.wide, k.type])
    permute = cgutils.get_or_insert_function(c.b.module, kind, "llvm.x86.avx2.permps")
    base = c.b.sext(c.b.extract_element(k, ir.Constant(ir.IntType(32), 0)), c.index)
    highest = c.b.sub(size, ir.Constant(c.index, 8 * vectors + 1))  # the last load must not leave the line
    base = c.b.select(c.b.icmp_signed("<", base, highest), base, highest)
    place = c.b.sub(k, c.splat(c.b.trunc(base, ir.IntType(32)), c.width))
    beyond = c.b.icmp_signed(">", place, ir.Constant(k.type, [ir.Constant(ir.IntType(32), 7)] * c.width))
    found = []
    for next_ in range(2):
        start = c.b.add(base, ir.Constant(c.index, next_))
        parts = [
            c.b.call(permute, [c.load(line, c.b.add(start, ir.Constant(c.index, 8 * v)), c.wide), place])
            for v in range(vectors)
        ]
        found.append(parts[0] if vectors == 1 else c.b.select(beyond, parts[1], parts[0]))
    return found[0], found[1]
