"""Conditions on flights, such as `controller == gp_mpc and speed > 6`: a small language of its own, never run as code.

    or, and, not, ( )
    KEY == VALUE   !=   <   <=   >   >=      also chained: 4 < speed <= 8
    KEY in [VALUE, VALUE]      KEY not in [...]
    KEY like PATTERN           with * and ?, such as controller like 'gp_*'
    KEY is null                KEY is not null

KEY: a column of the results or any key of the configuration. VALUE: a number in SI units, or with a unit (5mm, 20us);
a text, with quotes where it holds blanks; a list in quotes, '[4,0,0]'; true or false. A missing value fulfils no
comparison.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.report.axes.frame import SweepFrame, is_number, read_value

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "us": 1e-6, "ms": 1e-3, "s": 1.0, "deg": math.pi / 180, "%": 0.01}
COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq, "=": operator.eq, "!=": operator.ne, "<>": operator.ne,
    "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip
WORDS = ("and", "or", "not", "in", "like", "is", "null")
DEEPEST = 50  # brackets and `not` inside each other
_TOKEN = re.compile(
    r"""\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s?(?P<unit>mm|cm|us|ms|deg|m|s|%)?(?![\w.])
    |(?P<word>(?:[^\W\d]|[*?])[\w.+/:*?-]*)|(?P<text>'[^']*'|"[^"]*")|(?P<sign>==|!=|<>|<=|>=|&&|\|\||[=<>()\[\],]))""",
    re.VERBOSE,
)

Test = Callable[[int], bool]  # of the index of a row


class Token(NamedTuple):
    """kind: number, word, text, sign or end. at: where it stands in the condition."""

    kind: str
    value: Any
    at: int


def chosen(frame: SweepFrame, condition: str) -> list[bool]:
    """Which rows fulfil the condition; UsageError, in one line, where it cannot be read or names no key."""
    test = _Reader(frame, condition).whole()
    return [test(i) for i in range(len(frame.rows))]


class _Reader:
    """Reads a condition from left to right."""

    def __init__(self, frame: SweepFrame, condition: str) -> None:
        self._frame, self._condition = frame, condition
        self._tokens = list(_tokens(condition))
        self._at = self._depth = 0

    def whole(self) -> Test:
        test = self._any()
        if self._next.kind != "end":
            raise self._wrong("`and`, `or` or the end")
        return test

    @property
    def _next(self) -> Token:
        return self._tokens[self._at]

    def _take(self) -> Token:
        self._at += 1
        return self._tokens[self._at - 1]

    def _takes(self, *words: str) -> bool:
        """Whether these words come next; they are taken then."""
        tokens = self._tokens[self._at : self._at + len(words)]
        found = [token.value.lower() if token.kind in ("word", "sign") else None for token in tokens]
        if found != list(words):
            return False
        self._at += len(words)
        return True

    def _any(self) -> Test:
        tests = [self._all()]
        while self._takes("or") or self._takes("||"):
            tests.append(self._all())
        return tests[0] if len(tests) == 1 else lambda i: any(test(i) for test in tests)

    def _all(self) -> Test:
        tests = [self._one()]
        while self._takes("and") or self._takes("&&"):
            tests.append(self._one())
        return tests[0] if len(tests) == 1 else lambda i: all(test(i) for test in tests)

    def _one(self) -> Test:
        self._depth += 1
        if self._depth > DEEPEST:
            raise UsageError(f"--where: more than {DEEPEST} brackets inside each other")
        try:
            if self._takes("not"):
                inner = self._one()
                return lambda i: not inner(i)
            if self._takes("("):
                inner = self._any()
                if not self._takes(")"):
                    raise self._wrong("`)`")
                return inner
            return self._comparison()
        finally:
            self._depth -= 1

    def _comparison(self) -> Test:
        first = self._operand()
        if self._takes("is", "not", "null"):
            return _is_there(self._column(first))
        if self._takes("is", "null"):
            there = _is_there(self._column(first))
            return lambda i: not there(i)
        negated = self._takes("not")
        if self._takes("in"):
            return self._in(self._column(first), negated)
        if self._takes("like"):
            own, pattern = self._column(first), str(self._operand().value)
            return lambda i: own[i] is not None and fnmatchcase(str(own[i]), pattern) is not negated
        if negated:
            raise self._wrong("`in` or `like`")
        operands, signs = [first], []
        while self._next.kind == "sign" and self._next.value in COMPARISONS:
            signs.append(COMPARISONS[self._take().value])
            operands.append(self._operand())
        if not signs:
            raise self._wrong("a comparison such as == or <")
        return self._chain(operands, signs)

    def _chain(self, operands: Sequence[Token], signs: Sequence[Callable[[Any, Any], bool]]) -> Test:
        keys = [token.kind == "word" and self._frame.has(token.value) for token in operands]
        if not any(keys):
            self._column(operands[0])
        columns = [self._frame.column(t.value) if key else None for t, key in zip(operands, keys, strict=True)]
        for token, key in zip(operands, keys, strict=True):  # a misspelt key beside a number is no text
            others = [column for column in columns if column is not None]
            if not key and token.kind == "word" and all(_numbers(column) for column in others):
                self._column(token)

        def test(i: int) -> bool:
            values = [t.value if c is None else c[i] for t, c in zip(operands, columns, strict=True)]
            return all(_compared(sign, a, b) for sign, a, b in zip(signs, values, values[1:], strict=False))

        return test

    def _in(self, column: Sequence[Any], negated: bool) -> Test:
        closing = {"[": "]", "(": ")"}.get(self._take().value if self._next.kind == "sign" else "")
        if closing is None:
            raise self._wrong("a list such as [4, 8]")
        allowed = [self._operand().value]
        while self._takes(","):
            allowed.append(self._operand().value)
        if not self._takes(closing):
            raise self._wrong(f"`{closing}`")
        equal = COMPARISONS["=="]
        return lambda i: column[i] is not None and any(_compared(equal, column[i], one) for one in allowed) != negated

    def _operand(self) -> Token:
        token = self._next
        if token.kind in ("sign", "end") or (token.kind == "word" and token.value.lower() in WORDS):
            raise self._wrong("a key or a value")
        token = self._take()
        if token.kind == "word" and token.value.lower() in ("true", "false"):
            return token._replace(kind="truth", value=token.value.lower() == "true")
        return token

    def _column(self, token: Token) -> list[Any]:
        if token.kind != "word":
            raise UsageError(f"--where: {token.value!r} is a value; a key stands there")
        if not self._frame.has(token.value):
            hint = suggestion(token.value, self._frame.names, self._frame.swept)
            raise UsageError(f"--where: {token.value}: no such key or column{hint}")
        return self._frame.column(token.value)

    def _wrong(self, expected: str) -> UsageError:
        token = self._next
        found = "the end" if token.kind == "end" else repr(self._condition[token.at :][:20].strip())
        return UsageError(f"--where {self._condition!r}: expected {expected}, found {found}")


def _is_there(column: Sequence[Any]) -> Test:
    return lambda i: column[i] is not None


def _numbers(column: Sequence[Any]) -> bool:
    return all(is_number(value) for value in column if value is not None)


def _compared(sign: Callable[[Any, Any], bool], a: Any, b: Any) -> bool:
    """Whether a comparison holds; never with a missing value, nor the order of a number and a text."""
    if a is None or b is None:
        return False
    if is_number(a) and is_number(b):
        if sign in (operator.eq, operator.ne):  # 5 mm is 0.005
            return math.isclose(a, b, rel_tol=1e-12) is (sign is operator.eq)
        return sign(a, b)
    if isinstance(a, bool) or isinstance(b, bool):
        a, b = str(a).lower(), str(b).lower()
    if type(a) is not type(b) and not (is_number(a) and is_number(b)):
        return sign is operator.ne if sign in (operator.eq, operator.ne) else False
    return sign(a, b)


def _tokens(condition: str) -> Iterator[Token]:
    at = 0
    while condition[at:].strip():
        found = _TOKEN.match(condition, at)
        if found is None:
            raise UsageError(f"--where {condition!r}: cannot be read from {condition[at:].strip()[:20]!r} on")
        if (number := found["number"]) is not None:
            yield Token("number", float(number) * UNITS.get(found["unit"] or "", 1.0), found.start("number"))
        elif found["word"]:
            yield Token("word", found["word"], found.start("word"))
        elif found["text"]:
            text = found["text"][1:-1]
            yield Token("text", read_value(text) if text.startswith("[") else text, found.start("text"))
        else:
            yield Token("sign", found["sign"], found.start("sign"))
        at = found.end()
    yield Token("end", "", len(condition))
