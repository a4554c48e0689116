"""Small wrong changes of a source file: one sign, constant, comparison or function each.

    a + b <-> a - b      a * b <-> a / b      a ** b -> a * b      -a -> a         x += a <-> x -= a
    c -> 1.5 c, 0 -> 1, k -> k + 1 (whole numbers)                 x[i] -> x[j] (a neighbouring index)
    < <-> >, <= <-> >=, == <-> !=    sin <-> cos, fmin <-> fmax, min <-> max, and <-> or

Texts, annotations, what stands in a `raise`, and default values of names are left alone.
"""

import ast
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

BINARY = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult}
COMPARED = {
    ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
}  # fmt: skip
PAIRS = (("sin", "cos"), ("fmin", "fmax"), ("min", "max"), ("minimum", "maximum"), ("logic_and", "logic_or"))
NAMES = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])}


@dataclass(frozen=True)
class Mutant:
    """One change. file: path in the repository. place: function or class that it is in. line: of the original.

    before, after: the changed expression. number: which one of those that read alike in this place.
    source: the whole changed file.
    """

    file: str
    place: str
    line: int
    before: str
    after: str
    number: int
    source: str

    @property
    def key(self) -> str:
        """Name that stays the same while lines move."""
        count = f" #{self.number}" if self.number else ""
        return f"{self.file}:{self.place}: {self.before} => {self.after}{count}"


def mutants(file: str, source: str) -> list[Mutant]:
    """All mutants of a file, in the order of its lines."""
    text, found, seen = source.encode(), [], Counter()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node, place, after in _changes(ast.parse(source), "module", False):
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        before = " ".join(text[begin:end].decode().split())
        changed = (text[:begin] + after.encode() + text[end:]).decode()
        label = (place, before, after)
        found.append(Mutant(file, place, node.lineno, before, after, seen[label], changed))
        seen[label] += 1
    return found


def _changes(node: ast.AST, place: str, index: bool) -> Iterator[tuple[ast.AST, str, str]]:
    """(node, place, its replacement) for every change in the tree under `node`; index: inside a subscript."""
    if isinstance(node, (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)):
        return
    if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
        place = node.name if place == "module" else f"{place}.{node.name}"
        for child in node.body:
            yield from _changes(child, place, False)
        return
    if isinstance(node, ast.AnnAssign):
        if node.value is not None:
            yield from _changes(node.value, place, False)
        return
    replacement = _replacement(node, index)
    if replacement is not None:
        yield node, place, replacement
    if isinstance(node, ast.Subscript):
        yield from _changes(node.value, place, index)
        yield from _changes(node.slice, place, True)
        return
    for child in ast.iter_child_nodes(node):
        yield from _changes(child, place, index)


def _replacement(node: ast.AST, index: bool) -> str | None:
    """The changed source of the node, or None where it is not one to change."""
    match node:
        case ast.BinOp(left, op, right) if type(op) in BINARY and not _is_text(left) and not _is_text(right):
            return f"({ast.unparse(ast.BinOp(left, BINARY[type(op)](), right))})"
        case ast.AugAssign(target, op, value) if type(op) in BINARY:
            return ast.unparse(ast.AugAssign(target, BINARY[type(op)](), value))
        case ast.UnaryOp(ast.USub(), operand) if not index:
            return f"({ast.unparse(operand)})"
        case ast.Compare(left, [op], [right]) if type(op) in COMPARED:
            return f"({ast.unparse(ast.Compare(left, [COMPARED[type(op)]()], [right]))})"
        case ast.Attribute(value, name) if name in NAMES:
            return f"{ast.unparse(value)}.{NAMES[name]}"
        case ast.Name(name) if name in NAMES:
            return NAMES[name]
        case ast.Constant(value) if type(value) in (int, float):
            return _other_number(value, index)
    return None


def _other_number(value: float, index: bool) -> str:
    if index:
        return str(value + 1 if value < 2 else value - 1)
    if value == 0:
        return "1"
    return str(value + 1) if isinstance(value, int) else repr(1.5 * value)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, (ast.Constant, ast.JoinedStr)) and not isinstance(getattr(node, "value", ""), (int, float))
