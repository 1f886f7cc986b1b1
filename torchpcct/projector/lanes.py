"""The two inner loops of the plane kernels as explicit SIMD, through LLVM vectors.

A lane is an image that shares its geometry with the others: a rotated or mirrored copy, or another image of the batch.
All lanes of an edge use one interpolation index, so that every load is contiguous. numba's own vectoriser does not
find this reliably; LLVM vectors are portable all the same, LLVM splits or merges them for the machine it compiles for.

The vector width is the length of the tuple ``lanes``, so that numba compiles one version per width and caches each.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

__all__ = ["add_edges", "sum_edges"]

_FUSED = ("contract", "nsz", "arcp", "reassoc")


class _Code:
    """Helpers to write the loops; ``real`` is the scalar type, ``wide`` the vector of all lanes."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.b = builder
        self.width = signature.args[0].count
        self.dtype = signature.args[1].dtype
        self.real = ir.FloatType() if self.dtype == types.float32 else ir.DoubleType()
        self.wide = ir.VectorType(self.real, self.width)
        self.index = ir.IntType(64)
        self.values = [
            context.make_array(t)(context, builder, a).data if isinstance(t, types.Array) else a
            for t, a in zip(signature.args, args, strict=True)
        ]

    def at(self, pointer: Any, index: Any, kind: Any) -> Any:
        typed = self.b.bitcast(pointer, self.real.as_pointer())
        return self.b.bitcast(self.b.gep(typed, [index]), kind.as_pointer())

    def load(self, pointer: Any, index: Any, kind: Any) -> Any:
        return self.b.load(self.at(pointer, index, kind), align=self.dtype.bitwidth // 8)

    def store(self, value: Any, pointer: Any, index: Any) -> None:
        self.b.store(value, self.at(pointer, index, value.type), align=self.dtype.bitwidth // 8)

    def mul(self, a: Any, b: Any) -> Any:
        return self.b.fmul(a, b, flags=_FUSED)

    def add(self, a: Any, b: Any) -> Any:
        return self.b.fadd(a, b, flags=_FUSED)

    def sub(self, a: Any, b: Any) -> Any:
        return self.b.fsub(a, b, flags=_FUSED)

    def splat(self, value: Any) -> Any:
        undefined = ir.Constant(self.wide, ir.Undefined)
        one = self.b.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), self.width), [0] * self.width)
        return self.b.shuffle_vector(one, undefined, mask)

    def clamp(self, value: Any, top: Any) -> Any:
        zero = ir.Constant(self.real, 0.0)
        value = self.b.select(self.b.fcmp_ordered(">", value, zero), value, zero)
        return self.b.select(self.b.fcmp_ordered("<", value, top), value, top)

    def times(self, index: Any, factor: int) -> Any:
        return self.b.mul(index, ir.Constant(self.index, factor), flags=("nsw", "nuw"))

    def knot(self, p: Any, q: Any, r: Any, weight: Any, top: Any) -> tuple[Any, Any, Any]:
        """Index of the lower knot of ``t = p + q r`` and the weights of the two knots; ``r`` is a real number."""
        t = self.clamp(self.add(p, self.mul(q, r)), top)
        k = self.b.fptosi(t, ir.IntType(32))
        high = self.mul(weight, self.sub(t, self.b.sitofp(k, self.real)))
        return self.b.zext(k, self.index), self.sub(weight, high), high

    def slabs(self, r0: Any, r1: Any, body: Any) -> None:
        """Call ``body(indices, reals)`` for four slabs at a time, so that latencies overlap, then for the rest."""
        four = ir.Constant(self.index, 4)
        groups = self.b.sdiv(self.b.sub(r1, r0), four)
        with cgutils.for_range(self.b, groups) as loop:
            first = self.b.add(r0, self.b.mul(loop.index, four))
            real = self.b.sitofp(first, self.real)
            body(
                [self.b.add(first, ir.Constant(self.index, i)) for i in range(4)],
                [self.add(real, ir.Constant(self.real, float(i))) for i in range(4)],
            )
        with cgutils.for_range(self.b, r1, start=self.b.add(r0, self.b.mul(groups, four))) as loop:
            body([loop.index], [self.b.sitofp(loop.index, self.real)])


@intrinsic
def sum_edges(typingctx, lanes, sums, stride, p, q, weight, gain, e0, e1, r0, r1, top, out):
    """Sum slabs ``r0…r1`` at the edges ``e0…e1`` and add the differences of neighbouring edges to ``out``.

    ``lanes``: tuple of the vector's length W. ``sums``: running sums, slab r starts at ``r * stride`` (in elements),
    knots of W lanes each. ``p, q``: edge lines, ``weight``: per slab, ``gain``: per cell, ``out``: cells of W lanes.
    """
    signature = types.void(lanes, sums, stride, p, q, weight, gain, e0, e1, r0, r1, top, out)

    def codegen(context, builder, signature, args):
        c = _Code(context, builder, signature, args)
        _, sums, stride, p, q, weight, gain, e0, e1, r0, r1, top, out = c.values
        before = cgutils.alloca_once(builder, c.wide)
        totals = [cgutils.alloca_once(builder, c.wide) for _ in range(4)]
        zero = ir.Constant(c.wide, [ir.Constant(c.real, 0.0)] * c.width)
        builder.store(zero, before)
        with cgutils.for_range(builder, e1, start=e0) as edge:
            pe, qe = c.load(p, edge.index, c.real), c.load(q, edge.index, c.real)
            for total in totals:
                builder.store(zero, total)

            def body(indices, reals):
                knots = [c.knot(pe, qe, x, c.load(weight, r, c.real), top) for r, x in zip(indices, reals, strict=True)]
                for r, (k, low, high), total in zip(indices, knots, totals, strict=False):
                    base = builder.add(builder.mul(r, stride), c.times(k, c.width))
                    a = c.load(sums, base, c.wide)
                    b = c.load(sums, builder.add(base, ir.Constant(c.index, c.width)), c.wide)
                    value = c.add(c.mul(c.splat(low), a), c.mul(c.splat(high), b))
                    builder.store(c.add(builder.load(total), value), total)

            c.slabs(r0, r1, body)
            now = c.add(
                c.add(builder.load(totals[0]), builder.load(totals[1])),
                c.add(builder.load(totals[2]), builder.load(totals[3])),
            )
            with builder.if_then(builder.icmp_signed(">", edge.index, e0)):
                cell = builder.sub(edge.index, ir.Constant(c.index, 1))
                change = c.mul(c.splat(c.load(gain, cell, c.real)), c.sub(now, builder.load(before)))
                where = c.times(cell, c.width)
                c.store(c.add(c.load(out, where, c.wide), change), out, where)
            builder.store(now, before)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def add_edges(typingctx, lanes, out, stride, p, q, weight, e0, e1, r0, r1, top, values):
    """Transpose of ``sum_edges``: spread cell values (already times their gain) to the knots of slabs ``r0…r1``.

    ``values``: cells of W lanes, one more entry than cells. ``out``: slab r starts at ``(r - r0) * stride``.
    """
    signature = types.void(lanes, out, stride, p, q, weight, e0, e1, r0, r1, top, values)

    def codegen(context, builder, signature, args):
        c = _Code(context, builder, signature, args)
        _, out, stride, p, q, weight, e0, e1, r0, r1, top, values = c.values
        before = cgutils.alloca_once(builder, c.wide)
        zero = ir.Constant(c.wide, [ir.Constant(c.real, 0.0)] * c.width)
        builder.store(zero, before)
        last = builder.sub(e1, ir.Constant(c.index, 1))
        with cgutils.for_range(builder, e1, start=e0) as edge:
            pe, qe = c.load(p, edge.index, c.real), c.load(q, edge.index, c.real)
            cell = c.load(values, c.times(edge.index, c.width), c.wide)
            cell = builder.select(builder.icmp_signed("==", edge.index, last), zero, cell)
            value = c.sub(builder.load(before), cell)
            builder.store(cell, before)

            def body(indices, reals):
                knots = [c.knot(pe, qe, x, c.load(weight, r, c.real), top) for r, x in zip(indices, reals, strict=True)]
                for r, (k, low, high) in zip(indices, knots, strict=True):
                    base = builder.add(builder.mul(builder.sub(r, r0), stride), c.times(k, c.width))
                    above = builder.add(base, ir.Constant(c.index, c.width))
                    c.store(c.add(c.load(out, base, c.wide), c.mul(c.splat(low), value)), out, base)
                    c.store(c.add(c.load(out, above, c.wide), c.mul(c.splat(high), value)), out, above)

            c.slabs(r0, r1, body)
        return context.get_dummy_value()

    return signature, codegen
