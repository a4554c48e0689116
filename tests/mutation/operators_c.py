"""Small wrong changes of hand-written C: the same kinds as in operators.py, found in its tokens.

    a + b <-> a - b      a * b -> a / b      += <-> -=      < <-> >, >= -> <=      c -> 1.5 c, 0 -> 1, k -> k + 1

Operators are those with a space on either side, so that pointers and signs are none. Comments and what depends on the
processor (#if ... #endif) are left alone.
"""

import re
from collections import Counter

from tests.mutation.operators import Mutant

SKIPPED = re.compile(r"/\*.*?\*/|^#if.*?^#endif[^\n]*", re.DOTALL | re.MULTILINE)
TOKEN = re.compile(r"(?<= )(?:\+=|-=|>=|[+*<>-])(?= )|(?<![\w.])\d+(?:\.\d+)?(?![\w.])")
OTHER = {"+": "-", "-": "+", "*": "/", "+=": "-=", "-=": "+=", "<": ">", ">": "<", ">=": "<="}


def c_mutants(file: str, source: str) -> list[Mutant]:
    """All mutants of a C file, in the order of its lines."""
    kept = SKIPPED.sub(lambda match: re.sub(r"[^\n]", " ", match.group()), source)
    found, seen = [], Counter()
    for match in TOKEN.finditer(kept):
        begin, end = match.span()
        line = source.count("\n", 0, begin)
        after = OTHER.get(match.group()) or _other_number(match.group())
        whole = source.splitlines()[line]
        at = begin - (source.rfind("\n", 0, begin) + 1)
        label = (whole.strip(), match.group(), after)
        before = f"{whole[:at].strip()} [{match.group()}] {whole[at + end - begin :].strip()}"
        changed = source[:begin] + after + source[end:]
        found.append(Mutant(file, "body", line + 1, before, after, seen[label, before], changed))
        seen[label, before] += 1
    return found


def _other_number(text: str) -> str:
    if "." in text:
        return repr(1.5 * float(text) if float(text) else 1.0)
    return str(int(text) + 1)
