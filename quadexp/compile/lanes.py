"""Generated C for several points at once: in place of every number a vector, a lane of a register for each point.

The statements of the generated code stay as they are, as C's operators work on vectors too. What has to change are
numbers that are written out, and calls of the mathematical functions. Where the code chooses between numbers, lanes
would have to take different branches: such code has no form in lanes.
"""

from __future__ import annotations

import re

PRELUDE = """#include <math.h>
#ifdef __AVX512F__
enum { LANES = 8 };
#else
enum { LANES = 4 };
#endif
#ifndef REAL
#define REAL double
#endif
typedef REAL lanes __attribute__((vector_size(sizeof(REAL) * LANES)));
#define casadi_real lanes
#define NONE ((lanes){0})
#define OF_EACH(function) \\
  static inline lanes function##_of_each(lanes x) { \\
    lanes y; \\
    for (int l = 0; l < LANES; ++l) y[l] = function(x[l]); \\
    return y; \\
  }
#define sign(number) (((number) > 0) - ((number) < 0))
OF_EACH(exp)
OF_EACH(sqrt)
OF_EACH(fabs)
OF_EACH(sign)
#define exp exp_of_each
#define sqrt sqrt_of_each
#define fabs fabs_of_each
"""
REWRITTEN = (  # how generated code, and code of our own that it contains, writes numbers
    (r"#ifndef casadi_real\n#define casadi_real double\n#endif\n", ""),
    (r"\bdouble\b", "casadi_real"),
    (r"\? (arg\[\d+\]\[\d+\]) : 0;", r"!= 0 ? \1 : NONE;"),
    (r"(\b[aw]\d+) *= *(-?\d+\.\d*(?:e[-+]\d+)?);", r"{const REAL number=\2; \1=number-NONE;}"),
    (r"(\*\w\+\+|w\[row_y\[el\]\]) = 0\.?;", r"\1 = NONE;"),
    (r"(casadi_fill\(\w+, \d+, )([^)]*)\)", r"\1\2+NONE)"),
    (r"(casadi_sign\(casadi_real x\)) .*", r"\1 { return sign_of_each(x); }"),
    (r"casadi_real (\w+_default_in\()", r"int \1"),
    (r"= 0\.0;", "= NONE;"),
    (r"\{0\.0\}", "{NONE}"),
)
CALLED = re.compile(r"=(?:\w+\+)?(?:casadi_)?([a-z]\w*)\(")  # functions of numbers
KNOWN = re.compile(r"f\d+|sq|exp|sqrt|fabs|sign")
CHOSEN = re.compile(r"=\(!?a\d+[?<>=!&|]|=\(!")  # one of two numbers, or a condition


def in_lanes(source: str) -> str | None:
    """Generated C in lanes, compiled only where registers have four and more; None where it has no such form."""
    if CHOSEN.search(source) or not all(KNOWN.fullmatch(name) for name in CALLED.findall(source)):
        return None
    for pattern, replacement in REWRITTEN:
        source = re.sub(pattern, replacement, source)
    return f"#ifdef __AVX__\n{PRELUDE}{source}#endif\n"
