"""Compile every Triton kernel of projector and FBP for cards, without a card:

    python tests/bench/compile_triton.py [--capability 80 90]

Triton's interpreter, which tests what kernels compute, lets pass what does not compile: a loop that
changes a type, a value that is a constant where a size is 1. And it does not show that float32
kernels hold no float64 instruction, which this one asks of their assembly (PTX).
"""

import argparse
import os
import sys

if os.environ.pop("TRITON_INTERPRET", "0") == "1":
    os.execv(sys.executable, [sys.executable, *sys.argv])  # before Triton is imported

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from recon.analytic import backproject_triton as fbp
from torchpcct.projector.cuda import kernels as projector
from torchpcct.projector.cuda import vector_kernels as vectors

POINTERS = {"lines": "*i64"} | dict.fromkeys(
    ("axes", "segments", "buckets", "whole", "starts", "entries"), "*i32"
)
"""Tables of whole numbers."""
NUMBERS = (
    "images",
    "sums",
    "data",
    "out",
    "depths",
    "numbers",
    "heights",
    "widths",
    "projections",
    "tables",
    "table",
    "atan",
)
"""Arrays of the data's dtype."""
VECTORS = [
    {"PLANE": plane, "PARALLEL": parallel, "PARTS": parts, "BLOCK": 128}
    for plane in (False, True)
    for parallel in (False, True)
    for parts in (False, True)
]
SHAPES = {
    projector.project_plane: [{"PARALLEL": p, "BLOCK": 128} for p in (False, True)],
    projector.project_cone: [{"BLOCK": 256}],
    projector.backproject_plane: [{"PARALLEL": p, "BLOCK": 128} for p in (False, True)],
    projector.backproject_cone: [{"BLOCK": 256}],
    vectors.project_vectors: VECTORS,
    vectors.backproject_vectors: VECTORS,
    fbp._plane_kernel: [{"KIND": k, "TERMS": 7, "ENTRIES": 6, "BLOCK": 128} for k in range(3)],
    fbp._volume_kernel: [
        {"KIND": k, "TERMS": 7, "ENTRIES": 6, "ALONG": 2, "BLOCK": 64} for k in (1, 2)
    ],
}


def compiled(kernel, constants, number, ones, capability):
    """The assembly of a kernel; ``ones``: with all sizes 1, which Triton makes constants."""
    signature, values = {}, dict(constants)
    for name in kernel.arg_names:
        if name in constants:
            signature[name] = "constexpr"
        elif name in POINTERS:
            signature[name] = POINTERS[name]
        elif name in NUMBERS:
            signature[name] = f"*{number}"
        elif ones and name != "bits":
            signature[name], values[name] = "constexpr", 1
        else:
            signature[name] = "i32"
    target = GPUTarget("cuda", capability, 32)
    return triton.compile(ASTSource(kernel, signature, values), target=target).asm["ptx"]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--capability", type=int, nargs="+", default=[90])
    wrong = []
    for capability in parser.parse_args().capability:
        for kernel, shapes in SHAPES.items():
            for constants in shapes:
                for number, ones in (("fp32", False), ("fp32", True), ("fp64", False)):
                    ptx = compiled(kernel, constants, number, ones, capability)
                    double = ptx.count(".f64")
                    print(f"{kernel.__name__} sm_{capability} {number} {constants}: {double} f64")
                    if number == "fp32" and double:
                        wrong.append(kernel.__name__)
    if wrong:
        raise SystemExit(f"float64 in float32 kernels: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
