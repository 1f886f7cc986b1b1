"""The inner loops of the kernels as explicit SIMD, through LLVM vectors.

In the plane kernels a lane is an image that shares its geometry with the others: a rotated or
mirrored copy, or another image of the batch. All lanes of an edge use one interpolation index, so
that every load is contiguous. Copies of a grid off the axis lie a part of a voxel apart: then each
lane interpolates at its own place among three or four shared knots (``reach``: 2 or 3 intervals; 0:
the lanes lie at the same place). In the volume kernels the lanes lie along z. numba's own
vectoriser does not find these loops reliably; LLVM vectors are portable all the same, LLVM splits
or merges them for the machine it compiles for.

The vector width is the length of the tuple ``lanes`` and the reach that of the tuple ``reach``, so
that numba compiles one version of each and caches it.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numba.core.cpu import CPUContext
    from numba.core.typing import Signature


_FUSED = ("contract", "nsz", "arcp", "reassoc")


class _Code:
    """Helpers to write the loops; ``real``: the scalar type, ``wide``: all lanes, ``double``:
    those of two knots."""

    def __init__(
        self,
        context: CPUContext,
        builder: ir.IRBuilder,
        signature: Signature,
        args: Sequence[ir.Value],
    ) -> None:
        self.b, self.context = builder, context
        self.width = signature.args[0].count
        self.dtype = next(t for t in signature.args if isinstance(t, types.Array)).dtype
        self.real = ir.FloatType() if self.dtype == types.float32 else ir.DoubleType()
        self.wide = ir.VectorType(self.real, self.width)
        self.double = ir.VectorType(self.real, 2 * self.width)
        self.index = ir.IntType(64)
        self.values = [
            context.make_array(t)(context, builder, a).data if isinstance(t, types.Array) else a
            for t, a in zip(signature.args, args, strict=True)
        ]

    def at(self, pointer: ir.Value, index: ir.Value, kind: ir.Type) -> ir.Value:
        typed = self.b.bitcast(pointer, self.real.as_pointer())
        return self.b.bitcast(self.b.gep(typed, [index]), kind.as_pointer())

    def load(self, pointer: ir.Value, index: ir.Value, kind: ir.Type) -> ir.Value:
        return self.b.load(self.at(pointer, index, kind), align=self.dtype.bitwidth // 8)

    def store(self, value: ir.Value, pointer: ir.Value, index: ir.Value) -> None:
        self.b.store(value, self.at(pointer, index, value.type), align=self.dtype.bitwidth // 8)

    def mul(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self.b.fmul(a, b, flags=_FUSED)

    def add(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self.b.fadd(a, b, flags=_FUSED)

    def sub(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self.b.fsub(a, b, flags=_FUSED)

    def fused(self, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
        """``a * b + c``, rounded once where the machine can: the same in every kernel and width."""
        count = "" if not isinstance(a.type, ir.VectorType) else f"v{a.type.count}"
        name = f"llvm.fmuladd.{count}f{self.dtype.bitwidth}"
        kind = ir.FunctionType(a.type, [a.type] * 3)
        return self.b.call(cgutils.get_or_insert_function(self.b.module, kind, name), [a, b, c])

    def splat(self, value: ir.Value, count: int) -> ir.Value:
        """A scalar in all places of a vector."""
        undefined = ir.Constant(ir.VectorType(value.type, count), ir.Undefined)
        one = self.b.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
        return self.shuffle(one, undefined, [0] * count)

    def shuffle(self, a: ir.Value, b: ir.Value, places: list[int]) -> ir.Value:
        return self.b.shuffle_vector(
            a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(places)), places)
        )

    def clamp(self, value: ir.Value, top: ir.Value) -> ir.Value:
        zero = ir.Constant(value.type, None)
        value = self.b.select(self.b.fcmp_ordered(">", value, zero), value, zero)
        return self.b.select(self.b.fcmp_ordered("<", value, top), value, top)

    def times(self, index: ir.Value, factor: int) -> ir.Value:
        return self.b.mul(index, ir.Constant(self.index, factor), flags=("nsw", "nuw"))

    def _places(
        self, p: ir.Value, q: ir.Value, first: ir.Value, count: int, top: ir.Value
    ) -> tuple[ir.Value, ir.Value]:
        """Lower knots of ``t = p + q r`` and what ``t`` exceeds them by, for the slabs ``first …
        + count``."""
        reals, integers = (ir.VectorType(self.real, count), ir.VectorType(ir.IntType(32), count))
        r = self.splat(self.b.sitofp(first, self.real), count)
        r = self.add(
            r, ir.Constant(reals, [ir.Constant(self.real, float(i)) for i in range(count)])
        )
        t = self.add(self.splat(p, count), self.mul(self.splat(q, count), r))
        t = self.clamp(t, self.splat(top, count))
        k = self.b.fptosi(t, integers)
        return k, self.sub(t, self.b.sitofp(k, reals))

    def _index(self, k: ir.Value, i: int) -> ir.Value:
        return self.b.zext(self.b.extract_element(k, ir.Constant(ir.IntType(32), i)), self.index)

    def knots(
        self, p: ir.Value, q: ir.Value, first: ir.Value, count: int, weight: ir.Value, top: ir.Value
    ) -> list[tuple[ir.Value, ir.Value]]:
        """Lower knot of ``t = p + q r`` and the weights of its lanes and the next knot's, slabs
        ``first … + count``.

        Positions and weights of all slabs are one vector computation; ``weight`` points at the
        weight of slab 0.
        """
        k, part = self._places(p, q, first, count, top)
        w = self.load(weight, first, part.type)
        high = self.mul(w, part)
        low = self.sub(w, high)
        return [
            (
                self._index(k, i),
                self.shuffle(low, high, [i] * self.width + [count + i] * self.width),
            )
            for i in range(count)
        ]

    def knots_apart(
        self,
        p: ir.Value,
        q: ir.Value,
        first: ir.Value,
        count: int,
        top: ir.Value,
        ahead: ir.Value,
        reach: int,
    ) -> list[tuple[ir.Value, list[ir.Value]]]:
        """First shared knot and the lanes' weights of the ``reach + 1`` knots from there, for each
        slab.

        ``ahead``: how far each lane's position lies beyond the shared one, 0 ≤ ahead ≤ reach - 1.
        """
        k, part = self._places(p, q, first, count, top)
        one, zero = (
            ir.Constant(self.wide, [ir.Constant(self.real, 1.0)] * self.width),
            ir.Constant(self.wide, None),
        )
        result = []
        for i in range(count):
            at = self.add(self.shuffle(part, part, [i] * self.width), ahead)
            # Parts of the intervals that lie below the position; each knot gets the difference of
            # its two.
            covered = [one]
            for interval in range(reach):
                start = ir.Constant(
                    self.wide, [ir.Constant(self.real, float(interval))] * self.width
                )
                inside = self.sub(at, start) if interval else at
                if interval:
                    inside = self.b.select(self.b.fcmp_ordered(">", inside, zero), inside, zero)
                if interval < reach - 1:
                    inside = self.b.select(self.b.fcmp_ordered("<", inside, one), inside, one)
                covered.append(inside)
            weights = [self.sub(a, b) for a, b in pairwise(covered)] + [covered[-1]]
            result.append((self._index(k, i), weights))
        return result

    def ahead(self, apart: ir.Value, q: ir.Value) -> ir.Value:
        """Positions of the lanes beyond the shared one: ``q * apart[0] + apart[1]``."""
        across = self.load(apart, ir.Constant(self.index, 0), self.wide)
        along = self.load(apart, ir.Constant(self.index, self.width), self.wide)
        return self.add(self.mul(self.splat(q, self.width), across), along)

    def slabs(self, r0: ir.Value, r1: ir.Value, body: Callable[[ir.Value, int], None]) -> None:
        """Call ``body(first slab, how many)`` for groups of slabs, then for the rest one by one.

        Eight slabs at once fill the registers of few lanes; with many lanes they would spill.
        """
        size = 8 if self.width <= 2 else 4
        group = ir.Constant(self.index, size)
        groups = self.b.sdiv(self.b.sub(r1, r0), group)
        with cgutils.for_range(self.b, groups) as loop:
            body(self.b.add(r0, self.b.mul(loop.index, group)), size)
        with cgutils.for_range(self.b, r1, start=self.b.add(r0, self.b.mul(groups, group))) as loop:
            body(loop.index, 1)


def _written(
    write: Callable[..., None], *kinds: types.Type
) -> tuple[Signature, Callable[..., ir.Value]]:
    """Signature and code of an intrinsic without result: ``write(code, *values)`` writes its
    loops."""

    def codegen(
        context: CPUContext, builder: ir.IRBuilder, signature: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        code = _Code(context, builder, signature, args)
        write(code, *code.values)
        return context.get_dummy_value()

    return types.void(*kinds), codegen


@intrinsic
def sum_edges(
    typingctx, lanes, reach, sums, stride, p, q, weight, gain, e0, e1, r0, r1, top, apart, out
):
    """Sum slabs ``r0…r1`` at the edges ``e0…e1`` and add the differences of neighbouring edges to
    ``out``.

    ``lanes``: tuple of the vector's length W. ``reach``: tuple, see the module's text. ``sums``:
    running sums, slab r starts at ``r * stride`` (in elements), knots of W lanes each. ``p, q``:
    edge lines, ``weight``: per slab (with a reach: per slab and lane), ``gain``: per cell,
    ``apart``: see ``ahead``, ``out``: cells of W lanes.
    """
    signature = types.void(
        lanes, reach, sums, stride, p, q, weight, gain, e0, e1, r0, r1, top, apart, out
    )

    def codegen(context, builder, signature, args):
        c = _Code(context, builder, signature, args)
        intervals = signature.args[1].count
        _, _, sums, stride, p, q, weight, gain, e0, e1, r0, r1, top, apart, out = c.values
        before = cgutils.alloca_once(builder, c.wide)
        # Both knots of an interpolation lie side by side: one load, one product.
        total_type = c.wide if intervals else c.double
        totals = [cgutils.alloca_once(builder, total_type) for _ in range(4)]
        builder.store(ir.Constant(c.wide, None), before)
        with cgutils.for_range(builder, e1, start=e0) as edge:
            pe, qe = c.load(p, edge.index, c.real), c.load(q, edge.index, c.real)
            for total in totals:
                builder.store(ir.Constant(total_type, None), total)
            ahead = c.ahead(apart, qe) if intervals else None

            def apart_body(first, count):
                for i, (k, weights) in enumerate(
                    c.knots_apart(pe, qe, first, count, top, ahead, intervals)
                ):
                    r, total = (
                        builder.add(first, ir.Constant(c.index, i)),
                        totals[i % len(totals)],
                    )
                    base = builder.add(builder.mul(r, stride), c.times(k, c.width))
                    value = None
                    for m, w in enumerate(weights):
                        part = c.mul(
                            w,
                            c.load(
                                sums, builder.add(base, ir.Constant(c.index, m * c.width)), c.wide
                            ),
                        )
                        value = part if value is None else c.add(value, part)
                    value = c.mul(c.load(weight, c.times(r, c.width), c.wide), value)
                    builder.store(c.add(builder.load(total), value), total)

            def body(first, count):
                for i, (k, weights) in enumerate(c.knots(pe, qe, first, count, weight, top)):
                    r, total = (
                        builder.add(first, ir.Constant(c.index, i)),
                        totals[i % len(totals)],
                    )
                    values = c.load(
                        sums, builder.add(builder.mul(r, stride), c.times(k, c.width)), c.double
                    )
                    builder.store(c.add(builder.load(total), c.mul(weights, values)), total)

            c.slabs(r0, r1, apart_body if intervals else body)
            now = c.add(
                c.add(builder.load(totals[0]), builder.load(totals[1])),
                c.add(builder.load(totals[2]), builder.load(totals[3])),
            )
            if not intervals:
                now = c.add(
                    *(c.shuffle(now, now, list(range(i, i + c.width))) for i in (0, c.width))
                )
            with builder.if_then(builder.icmp_signed(">", edge.index, e0)):
                cell = builder.sub(edge.index, ir.Constant(c.index, 1))
                change = c.mul(
                    c.splat(c.load(gain, cell, c.real), c.width), c.sub(now, builder.load(before))
                )
                where = c.times(cell, c.width)
                c.store(c.add(c.load(out, where, c.wide), change), out, where)
            builder.store(now, before)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def add_edges(
    typingctx, lanes, reach, out, stride, p, q, weight, e0, e1, r0, r1, top, apart, values
):
    """Transpose of ``sum_edges``: spread cell values (already times their gain) to the knots of
    slabs ``r0…r1``.

    ``values``: cells of W lanes, one more entry than cells. ``out``: slab r starts at ``(r - r0) *
    stride``.
    """
    signature = types.void(
        lanes, reach, out, stride, p, q, weight, e0, e1, r0, r1, top, apart, values
    )

    def codegen(context, builder, signature, args):
        c = _Code(context, builder, signature, args)
        intervals = signature.args[1].count
        _, _, out, stride, p, q, weight, e0, e1, r0, r1, top, apart, values = c.values
        before = cgutils.alloca_once(builder, c.wide)
        zero = ir.Constant(c.wide, None)
        builder.store(zero, before)
        last = builder.sub(e1, ir.Constant(c.index, 1))
        with cgutils.for_range(builder, e1, start=e0) as edge:
            pe, qe = c.load(p, edge.index, c.real), c.load(q, edge.index, c.real)
            cell = c.load(values, c.times(edge.index, c.width), c.wide)
            cell = builder.select(builder.icmp_signed("==", edge.index, last), zero, cell)
            value = c.sub(builder.load(before), cell)
            builder.store(cell, before)

            twice = c.shuffle(value, value, list(range(c.width)) * 2)
            ahead = c.ahead(apart, qe) if intervals else None

            def apart_body(first, count):
                for i, (k, weights) in enumerate(
                    c.knots_apart(pe, qe, first, count, top, ahead, intervals)
                ):
                    r = builder.add(first, ir.Constant(c.index, i))
                    base = builder.add(builder.mul(builder.sub(r, r0), stride), c.times(k, c.width))
                    given = c.mul(c.load(weight, c.times(r, c.width), c.wide), value)
                    for m, w in enumerate(weights):
                        where = builder.add(base, ir.Constant(c.index, m * c.width))
                        c.store(c.add(c.load(out, where, c.wide), c.mul(w, given)), out, where)

            def body(first, count):
                for i, (k, weights) in enumerate(c.knots(pe, qe, first, count, weight, top)):
                    r = builder.add(first, ir.Constant(c.index, i))
                    base = builder.add(builder.mul(builder.sub(r, r0), stride), c.times(k, c.width))
                    c.store(c.add(c.load(out, base, c.double), c.mul(weights, twice)), out, base)

            c.slabs(r0, r1, apart_body if intervals else body)
        return context.get_dummy_value()

    return signature, codegen


def _columns(c: _Code, size: ir.Value, body: Callable[[ir.Value, int], None]) -> None:
    """Call ``body(first, vectors)`` for stretches of four vectors of W lanes along z, then of
    one."""
    long = 4 * c.width
    groups = c.b.sdiv(size, ir.Constant(c.index, long))
    with cgutils.for_range(c.b, groups) as loop:
        body(c.times(loop.index, long), 4)
    rest = c.times(groups, long)
    ones = c.b.sdiv(c.b.sub(size, rest), ir.Constant(c.index, c.width))
    with cgutils.for_range(c.b, ones) as loop:
        body(c.b.add(rest, c.times(loop.index, c.width)), 1)


@intrinsic
def add_lines(typingctx, lanes, lines, offset, low, high, e0, e1, size, below, above):
    """``below += Σ_e low[e] lines[offset[e]:]`` and ``above += Σ_e high[e] lines[offset[e]:]``, e
    from e0 to e1.

    ``size``: elements of a line, a multiple of the vector's length W. The sums stay in registers.
    """

    def write(c, _, lines, offset, low, high, e0, e1, size, below, above):
        _gather_lines(c, lines, offset, (low, high), e0, e1, size, (below, above), fresh=False)

    return _written(write, lanes, lines, offset, low, high, e0, e1, size, below, above)


@intrinsic
def sum_lines(typingctx, lanes, lines, offset, low, e0, e1, size, total):
    """``total = Σ_e low[e] lines[offset[e]:]``: as ``add_lines``, for slabs that belong to no
    two layers."""

    def write(c, _, lines, offset, low, e0, e1, size, total):
        _gather_lines(c, lines, offset, (low,), e0, e1, size, (total,), fresh=True)

    return _written(write, lanes, lines, offset, low, e0, e1, size, total)


def _gather_lines(
    c: _Code,
    lines: ir.Value,
    offset: ir.Value,
    weights: Sequence[ir.Value],
    e0: ir.Value,
    e1: ir.Value,
    size: ir.Value,
    targets: Sequence[ir.Value],
    fresh: bool,
) -> None:
    """Weighted sums of lines, one per target; ``fresh``: what the targets held before is
    overwritten."""
    b = c.b
    sums = [[cgutils.alloca_once(b, c.wide) for _ in range(4)] for _ in targets]

    def body(first: ir.Value, vectors: int) -> None:
        places = [b.add(first, ir.Constant(c.index, i * c.width)) for i in range(vectors)]
        for target, total in zip(targets, sums, strict=True):
            for place, part in zip(places, total, strict=False):
                b.store(ir.Constant(c.wide, None) if fresh else c.load(target, place, c.wide), part)
        with cgutils.for_range(b, e1, start=e0) as entry:
            start = b.load(b.gep(offset, [entry.index]))
            shares = [c.splat(c.load(w, entry.index, c.real), c.width) for w in weights]
            for i, place in enumerate(places):
                value = c.load(lines, b.add(start, place), c.wide)
                for share, total in zip(shares, sums, strict=True):
                    b.store(c.add(b.load(total[i]), c.mul(share, value)), total[i])
        for target, total in zip(targets, sums, strict=True):
            for place, part in zip(places, total, strict=False):
                c.store(b.load(part), target, place)

    _columns(c, size, body)


@intrinsic
def spread_lines(typingctx, lanes, lines, offset, low, high, e0, e1, size, below, above):
    """Transpose of ``add_lines``: ``lines[offset[e]:] += low[e] below + high[e] above`` for e
    from e0 to e1."""

    def write(c, _, lines, offset, low, high, e0, e1, size, below, above):
        _spread(c, lines, offset, (low, high), e0, e1, size, (below, above))

    return _written(write, lanes, lines, offset, low, high, e0, e1, size, below, above)


@intrinsic
def spread_line(typingctx, lanes, lines, offset, low, e0, e1, size, line):
    """Transpose of ``sum_lines``: ``lines[offset[e]:] += low[e] line`` for e from e0 to e1."""

    def write(c, _, lines, offset, low, e0, e1, size, line):
        _spread(c, lines, offset, (low,), e0, e1, size, (line,))

    return _written(write, lanes, lines, offset, low, e0, e1, size, line)


def _spread(
    c: _Code,
    lines: ir.Value,
    offset: ir.Value,
    weights: Sequence[ir.Value],
    e0: ir.Value,
    e1: ir.Value,
    size: ir.Value,
    sources: Sequence[ir.Value],
) -> None:
    """Add weighted sums of the sources to lines."""
    b = c.b

    def body(first: ir.Value, vectors: int) -> None:
        places = [b.add(first, ir.Constant(c.index, i * c.width)) for i in range(vectors)]
        given = [[c.load(source, place, c.wide) for place in places] for source in sources]
        with cgutils.for_range(b, e1, start=e0) as entry:
            start = b.load(b.gep(offset, [entry.index]))
            shares = [c.splat(c.load(w, entry.index, c.real), c.width) for w in weights]
            for i, place in enumerate(places):
                where = b.add(start, place)
                value = c.load(lines, where, c.wide)
                for share, source in zip(shares, given, strict=True):
                    value = c.add(value, c.mul(share, source[i]))
                c.store(value, lines, where)

    _columns(c, size, body)
