"""The small changes that can be made to a module's text, by its syntax tree.

Each leaves the rest of the text as it is. Annotations, docstrings, decorators and the words of
errors stay: no test is to pin those.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

COMPARED = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
COMPUTED = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitOr,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
WORDED = (ast.Raise, ast.JoinedStr)  # of which nothing inside is changed


@dataclass(frozen=True)
class Change:
    """One change: bytes `start` to `end` of a module become `after`."""

    start: int
    end: int
    line: int
    place: str
    kind: str
    before: str
    after: str

    @property
    def key(self) -> str:
        """A name that stays the same while other parts of the module are edited."""
        return f"{self.place}: {self.before} → {self.after}"

    def applied(self, text: str) -> str:
        """The module's text with this change."""
        data = text.encode()
        return (data[: self.start] + self.after.encode() + data[self.end :]).decode()


def changes(text: str) -> list[Change]:
    """Lists the changes to a module's text, in its order, each once."""
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = {}
    for node, place in _visited(ast.parse(text), ""):
        for kind, part, after in _replacements(node):
            start = starts[part.lineno - 1] + part.col_offset
            end = starts[part.end_lineno - 1] + part.end_col_offset
            before = text.encode()[start:end].decode()
            change = Change(start, end, part.lineno, place, kind, before, after)
            found.setdefault(change.key, change)
    return sorted(found.values(), key=lambda change: (change.start, change.end, change.after))


def _visited(node: ast.AST, place: str) -> Iterator[tuple[ast.AST, str]]:
    """The nodes that may be changed, each with the function that it is in."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        place = f"{place}.{node.name}".lstrip(".")
    if isinstance(node, ast.expr | ast.stmt):
        yield node, place
    if isinstance(node, WORDED):
        return
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not _is_fixed(child):
                yield from _visited(child, place)


def _is_fixed(node: ast.AST) -> bool:
    docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    return docstring or types


def _replacements(node: ast.AST) -> Iterator[tuple[str, ast.AST, str]]:
    """Kinds of change at a node, the part of it that goes, and what comes instead."""
    if isinstance(node, ast.expr):
        for kind, changed in _expressions(node):
            yield kind, node, changed if kind == "constant" else f"({changed})"
    elif isinstance(node, ast.If | ast.While) and isinstance(
        node.test, ast.Name | ast.Attribute | ast.Call
    ):
        yield "logic", node.test, f"(not {ast.unparse(node.test)})"
    elif isinstance(node, ast.Return) and node.value is not None:
        yield "return", node, "return None"
    elif isinstance(node, ast.Break):
        yield "jump", node, "continue"
    elif isinstance(node, ast.Continue):
        yield "jump", node, "break"
    elif isinstance(node, ast.AugAssign | ast.Raise) or (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    ):
        yield "deleted", node, "pass"


def _expressions(node: ast.expr) -> Iterator[tuple[str, str]]:
    match node:
        case ast.Compare(left, [op], [right]):
            for other in COMPARED[type(op)]:
                yield "comparison", ast.unparse(ast.Compare(left, [other()], [right]))
        case ast.BinOp(left, ast.MatMult(), right):
            yield "order", ast.unparse(ast.BinOp(right, ast.MatMult(), left))
        case ast.BinOp(left, op, right) if type(op) in COMPUTED:
            yield "arithmetic", ast.unparse(ast.BinOp(left, COMPUTED[type(op)](), right))
        case ast.BoolOp(op, values):
            other = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield "logic", ast.unparse(ast.BoolOp(other, values))
            yield "logic", ast.unparse(values[0])
        case ast.UnaryOp(ast.Not() | ast.USub() | ast.Invert(), operand):
            yield "sign", ast.unparse(operand)
        case ast.IfExp(test, body, orelse):
            yield "choice", ast.unparse(ast.IfExp(test, orelse, body))
        case ast.Call(func, [first, second, *rest], keywords) if not isinstance(
            first, ast.Starred
        ) and not isinstance(second, ast.Starred):
            yield "order", ast.unparse(ast.Call(func, [second, first, *rest], keywords))
        case ast.Constant(bool(value)):
            yield "constant", repr(not value)
        case ast.Constant(int(value)):
            yield "constant", repr(value + 1)
            if value > 0:
                yield "constant", repr(value - 1)
        case ast.Constant(float(value)):
            yield "constant", repr(value * 2 if value else 1.0)
