"""Linear interpolation, eight positions at a time, as explicit SIMD: at equally spaced positions
the steps between them, and at the positions of a line of pixels.

Row edges lie evenly along a line of voxels, and columns nearly so along a line of pixels. Eight
neighbours of them read at most 8 (16) knots when they lie less than one (two) knots apart: these
are loaded whole and picked in registers, where AVX2 has a permutation for it. Elsewhere, and for
larger steps, each pair of knots is loaded on its own. The arithmetic is the same.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import TYPE_CHECKING

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from torchpcct.projector.cpu.simd import _written

if TYPE_CHECKING:
    from torchpcct.projector.cpu.simd import _Code


# Eight positions at most this far apart fall on 8, or on 16, neighbouring knots.
_STEP_OF_8 = 0.999
_STEP_OF_16 = 2.13


@intrinsic
def add_steps(typingctx, lanes, line, zeta0, step, last, size, gain, out, count):
    """``out[i] += gain * (line(i + 1) - line(i))`` for i < count, ``line(i)`` that at ``zeta0 +
    step * i``.

    ``line``: knots 0…last, to which positions are clamped, with ``size`` elements, > last.
    ``lanes``: tuple of the vector's length W. ``count``: a multiple of W.
    """

    def write(c, _, line, zeta0, step, last, size, gain, out, count):
        wide = c.splat(gain, c.width)
        steps = _Steps(c, line, zeta0, step, last, size, count)
        steps.give(
            lambda change, at: c.store(c.add(c.load(out, at, c.wide), c.mul(wide, change)), out, at)
        )

    return _written(write, lanes, line, zeta0, step, last, size, gain, out, count)


@intrinsic
def set_steps(typingctx, lanes, line, zeta0, step, last, size, out, count):
    """``out[i] = line(i + 1) - line(i)`` for i < count, see ``add_steps``."""

    def write(c, _, line, zeta0, step, last, size, out, count):
        steps = _Steps(c, line, zeta0, step, last, size, count)
        steps.give(lambda change, at: c.store(change, out, at))

    return _written(write, lanes, line, zeta0, step, last, size, out, count)


@intrinsic
def add_between(typingctx, lanes, near, far, index, row, size, count, total):
    """``total[i] += near[i] row[index[i]] + far[i] row[index[i] + 1]`` for i < count: places of W
    lanes each.

    ``index``: int32; that of neighbours in order, but for one by rounding. ``row``: ``size``
    places; of one lane 17 at least, and 16 behind the last that is read.
    """

    def write(c, _, near, far, index, row, size, count, total):
        rest = ir.Constant(c.index, 0)
        if c.width == 1 and _picks(c):
            rest = _add_eights(c, near, far, index, row, size, count, total)
        with cgutils.for_range(c.b, count, start=rest) as loop:
            _add_one(c, near, far, index, row, loop.index, total)

    return _written(write, lanes, near, far, index, row, size, count, total)


def _add_one(
    c: _Code,
    near: ir.Value,
    far: ir.Value,
    index: ir.Value,
    row: ir.Value,
    i: ir.Value,
    total: ir.Value,
) -> None:
    """``add_between`` at one place."""
    k = c.b.zext(c.b.load(c.b.gep(index, [i])), c.index)
    value = c.load(total, c.times(i, c.width), c.wide)
    for weights, at in ((far, c.b.add(k, ir.Constant(c.index, 1))), (near, k)):
        weight = c.splat(c.load(weights, i, c.real), c.width)
        value = c.fused(weight, c.load(row, c.times(at, c.width), c.wide), value)
    c.store(value, total, c.times(i, c.width))


def _add_eights(
    one: _Code,
    near: ir.Value,
    far: ir.Value,
    index: ir.Value,
    row: ir.Value,
    size: ir.Value,
    count: ir.Value,
    total: ir.Value,
) -> ir.Value:
    """``add_between`` at all whole eights of places with one lane; returns the first place left."""
    c = copy(one)
    c.width, c.wide = 8, ir.VectorType(c.real, 8)
    integer = ir.IntType(32)
    eights = c.b.sdiv(count, ir.Constant(c.index, 8))
    with cgutils.for_range(c.b, eights) as loop:
        i = c.times(loop.index, 8)
        k = c.b.load(
            c.b.bitcast(c.b.gep(index, [i]), ir.VectorType(integer, 8).as_pointer()), align=4
        )
        ends = [c.b.extract_element(k, ir.Constant(integer, at)) for at in (0, 7)]
        falls = c.b.icmp_signed(">", *ends)
        low, high = c.b.select(falls, ends[1], ends[0]), c.b.select(falls, ends[0], ends[1])
        # one on either side, for neighbours that rounding puts out of order
        low = c.b.sub(low, ir.Constant(integer, 1))
        low = c.b.select(
            c.b.icmp_signed("<", low, ir.Constant(integer, 0)), ir.Constant(integer, 0), low
        )
        fits = c.b.icmp_signed("<", c.b.sub(high, low), ir.Constant(integer, 15))
        with c.b.if_else(fits) as (then, otherwise):
            with then:
                value = c.load(total, i, c.wide)
                for weights, knots in zip(
                    (far, near), _pick(c, row, size, k, 2, low)[::-1], strict=True
                ):
                    value = c.fused(c.load(weights, i, c.wide), knots, value)
                c.store(value, total, i)
            with otherwise, cgutils.for_range(c.b, ir.Constant(c.index, 8)) as each:
                _add_one(one, near, far, index, row, c.b.add(i, each.index), total)
    return c.times(eights, 8)


def _picks(c: _Code) -> bool:
    """Whether knots can be picked in registers."""
    features = c.context.codegen().magic_tuple()[2].split(",")
    return c.dtype == types.float32 and "+avx2" in features


class _Steps:
    """What a line rises by from each of evenly spaced positions to the next."""

    def __init__(
        self,
        c: _Code,
        line: ir.Value,
        zeta0: ir.Value,
        step: ir.Value,
        last: ir.Value,
        size: ir.Value,
        count: ir.Value,
    ) -> None:
        self.c, self.line, self.step, self.size, self.count = c, line, step, size, count
        self.positions = _Positions(c, zeta0, step, last)

    def give(self, take: Callable[[ir.Value, ir.Value], None]) -> None:
        """Call ``take(W steps, index of the first)`` for all of them."""
        c, b = self.c, self.c.b
        if c.width != 8 or not _picks(c):
            self._run(self._one_by_one, take)
            return
        fits = [
            b.and_(
                b.fcmp_ordered("<=", self.step, ir.Constant(c.real, limit)),
                b.icmp_signed(">", self.size, ir.Constant(c.index, knots)),
            )
            for limit, knots in ((_STEP_OF_8, 8), (_STEP_OF_16, 16))
        ]
        with b.if_else(fits[0]) as (then, otherwise):
            with then:
                self._run(lambda k: _pick(c, self.line, self.size, k, 1), take)
            with otherwise, b.if_else(fits[1]) as (wide, rest):
                with wide:
                    self._run(lambda k: _pick(c, self.line, self.size, k, 2), take)
                with rest:
                    self._run(self._one_by_one, take)

    def _run(
        self,
        pick: Callable[[ir.Value], tuple[ir.Value, ir.Value]],
        take: Callable[[ir.Value, ir.Value], None],
    ) -> None:
        """The values of a vector stay in registers until those of the next are known."""
        c = self.c

        def values(first: ir.Value) -> ir.Value:
            k, part = self.positions.at(first)
            low, high = pick(k)
            return c.add(low, c.mul(part, c.sub(high, low)))

        held = cgutils.alloca_once(c.b, c.wide)
        c.b.store(values(ir.Constant(c.index, 0)), held)
        with cgutils.for_range(c.b, c.b.sdiv(self.count, ir.Constant(c.index, c.width))) as loop:
            first = c.times(loop.index, c.width)
            here, next_ = c.b.load(held), values(c.b.add(first, ir.Constant(c.index, c.width)))
            take(c.sub(c.shuffle(here, next_, list(range(1, c.width + 1))), here), first)
            c.b.store(next_, held)

    def _one_by_one(self, k: ir.Value) -> tuple[ir.Value, ir.Value]:
        c = self.c
        pair = ir.VectorType(c.real, 2)
        low = high = ir.Constant(c.wide, ir.Undefined)
        for i in range(c.width):
            place = ir.Constant(ir.IntType(32), i)
            both = c.load(self.line, c.b.sext(c.b.extract_element(k, place), c.index), pair)
            for j in range(2):
                value = c.b.extract_element(both, ir.Constant(ir.IntType(32), j))
                if j:
                    high = c.b.insert_element(high, value, place)
                else:
                    low = c.b.insert_element(low, value, place)
        return low, high


class _Positions:
    """Lower knots and what the positions exceed them by."""

    def __init__(self, c: _Code, zeta0: ir.Value, step: ir.Value, last: ir.Value) -> None:
        self.c, self.integers = c, ir.VectorType(ir.IntType(32), c.width)
        self.zeta0, self.step = c.splat(zeta0, c.width), c.splat(step, c.width)
        self.top = c.splat(c.b.sitofp(last, c.real), c.width)
        highest = c.b.sub(c.b.trunc(last, ir.IntType(32)), ir.Constant(ir.IntType(32), 1))
        self.highest = c.splat(highest, c.width)
        self.steps = ir.Constant(c.wide, [ir.Constant(c.real, float(i)) for i in range(c.width)])

    def at(self, first: ir.Value) -> tuple[ir.Value, ir.Value]:
        c = self.c
        i = c.add(c.splat(c.b.sitofp(first, c.real), c.width), self.steps)
        zeta = c.clamp(c.add(self.zeta0, c.mul(self.step, i)), self.top)
        k = c.b.fptosi(zeta, self.integers)
        k = c.b.select(c.b.icmp_signed("<", k, self.highest), k, self.highest)
        return k, c.sub(zeta, c.b.sitofp(k, c.wide))


def _pick(
    c: _Code,
    line: ir.Value,
    size: ir.Value,
    k: ir.Value,
    vectors: int,
    lowest: ir.Value | None = None,
) -> tuple[ir.Value, ir.Value]:
    """Knots ``k`` and ``k + 1`` out of ``vectors`` registers of 8 knots that begin at ``lowest``,
    by default the first of ``k``."""
    kind = ir.FunctionType(c.wide, [c.wide, k.type])
    permute = cgutils.get_or_insert_function(c.b.module, kind, "llvm.x86.avx2.permps")
    if lowest is None:
        lowest = c.b.extract_element(k, ir.Constant(ir.IntType(32), 0))
    base = c.b.sext(lowest, c.index)
    # the last load must not leave the line
    highest = c.b.sub(size, ir.Constant(c.index, 8 * vectors + 1))
    base = c.b.select(c.b.icmp_signed("<", base, highest), base, highest)
    place = c.b.sub(k, c.splat(c.b.trunc(base, ir.IntType(32)), c.width))
    beyond = c.b.icmp_signed(
        ">", place, ir.Constant(k.type, [ir.Constant(ir.IntType(32), 7)] * c.width)
    )
    found = []
    for next_ in range(2):
        start = c.b.add(base, ir.Constant(c.index, next_))
        parts = [
            c.b.call(
                permute, [c.load(line, c.b.add(start, ir.Constant(c.index, 8 * v)), c.wide), place]
            )
            for v in range(vectors)
        ]
        found.append(parts[0] if vectors == 1 else c.b.select(beyond, parts[1], parts[0]))
    return found[0], found[1]
