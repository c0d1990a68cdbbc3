"""Parser of `sbt.metrics.stl`: from text to a formula; errors point at the column.

    implication = or { "->" implication }
    or          = and { "or" and }
    and         = until { "and" until }
    until       = unary [ "U" [bounds] until ]
    unary       = ("not" | "G" [bounds] | "F" [bounds]) unary | comparison
    comparison  = sum [ (">" | ">=" | "<" | "<=") sum ]
    sum         = product { ("+" | "-") product }
    product     = sign { ("*" | "/") sign }
    sign        = "-" sign | number | signal | "(" implication ")"
    bounds      = "[" number "," (number | "inf") "]"

Arithmetic applies to numbers and signals, logic to comparisons; mixtures are refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn

from sbt.errors import InputError

__all__ = ["Binary", "Number", "Signal", "Term", "Unary", "horizon", "is_formula", "parse"]

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?![\w.])|(?P<name>[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)"
    r"|(?P<mark>->|>=|<=|[-+*/()<>\[\],]))"
)
_WORDS = ("and", "or", "not", "G", "F", "U", "inf")
_COMPARISONS = (">", ">=", "<", "<=")
_MAX_TOKENS = 1000
_MAX_DEPTH = 40
"""Nested parentheses and prefix operators: far more than in practice, and far below the recursion limit."""


@dataclass(frozen=True)
class Number:
    """A constant."""

    value: float


@dataclass(frozen=True)
class Signal:
    """A named signal."""

    name: str


@dataclass(frozen=True)
class Unary:
    """`neg` of a number; `not`, `G` or `F` of a formula, the last two over [low, high] (s)."""

    op: str
    of: Term
    low: float = 0.0
    high: float = math.inf


@dataclass(frozen=True)
class Binary:
    """`+ - * /` of numbers, a comparison of numbers, or `and`, `or`, `->`, `U` of formulas."""

    op: str
    left: Term
    right: Term
    low: float = 0.0
    high: float = math.inf


Term = Number | Signal | Unary | Binary


def is_formula(term: Term) -> bool:
    """Return whether a term is logical, rather than numeric."""
    return isinstance(term, Unary | Binary) and term.op not in ("neg", "+", "-", "*", "/")


def horizon(term: Term) -> float:
    """Return how far a formula looks ahead where its intervals say so (s); to the end of a run, it asks for no time.

    >>> horizon(parse("G[0,20](gap > 2 -> F[1,3](speed < 1))")), horizon(parse("G(gap > 2)"))
    (23.0, 0.0)
    """
    inner = [horizon(part) for part in (getattr(term, name, None) for name in ("of", "left", "right")) if part is not None]
    high = getattr(term, "high", math.inf)
    return max(inner, default=0.0) + (high if math.isfinite(high) else 0.0)


def parse(text: str, check: Callable[[str], None] = lambda name: None) -> Term:
    """Return the formula that a text represents.

    Args:
        text: such as `G[0,20](gap > 2 and ttc > 1.5)`.
        check: raises an `InputError` for a name that is not a signal.

    Raises:
        InputError: the text is not a formula; the message points at the column.
    """
    parser = _Parser(text, check)
    term = parser.implication()
    parser.expect_end()
    return parser.formula(term, 0, "the whole")


class _Parser:
    """Recursive descent parser; tokens are (kind, text, column from 0)."""

    def __init__(self, text: str, check: Callable[[str], None]):
        self._text = text
        self._check = check
        self._tokens = self._split()
        self._at = 0
        self._depth = 0

    def _split(self) -> list[tuple[str, str, int]]:
        tokens, at, end = [], 0, len(self._text.rstrip())
        while at < end:
            match = _TOKEN.match(self._text, at)
            if match is None:
                at += len(self._text[at:]) - len(self._text[at:].lstrip())
                self._fail(at, f"cannot read '{self._text[at : at + 12].split()[0]}'")
            kind = str(match.lastgroup)
            tokens.append((kind, match[kind], match.start(kind)))
            at = match.end()
            if len(tokens) > _MAX_TOKENS:
                self._fail(match.start(kind), f"a formula must have at most {_MAX_TOKENS} words and marks")
        return [*tokens, ("end", "the end", end)]

    def _fail(self, column: int, why: str) -> NoReturn:
        raise InputError(f"stl, column {column + 1}: {why}\n  {self._text}\n  {' ' * column}^")

    def _peek(self) -> str:
        return self._tokens[self._at][1] if self._tokens[self._at][0] != "end" else ""

    def _next(self) -> tuple[str, str, int]:
        token = self._tokens[self._at]
        self._at = min(self._at + 1, len(self._tokens) - 1)
        return token

    def _expect(self, mark: str) -> None:
        _, text, column = self._next()
        if text != mark:
            self._fail(column, f"'{mark}' must be here, but there is '{text}'")

    def expect_end(self) -> None:
        kind, text, column = self._next()
        if kind != "end":
            self._fail(column, f"the formula must end here or go on with an operator, but there is '{text}'")

    def formula(self, term: Term, column: int, where: str) -> Term:
        if not is_formula(term):
            self._fail(column, f"{where} must be true or false, such as 'gap > 2', but it is a number")
        return term

    def _number(self, term: Term, column: int, where: str) -> Term:
        if is_formula(term):
            self._fail(column, f"{where} must be a number or a signal, but it is true or false")
        return term

    def _column(self) -> int:
        return self._tokens[self._at][2]

    def _chain(self, ops: tuple[str, ...], part: Callable[[], Term], ensure: Callable[[Term, int, str], Term]) -> Term:
        """Parse left-associative operators of equal precedence."""
        start = self._column()
        term = part()
        while self._peek() in ops:
            op = self._next()[1]
            ensure(term, start, f"left of '{op}'")
            start_right = self._column()
            term = Binary(op, term, ensure(part(), start_right, f"right of '{op}'"))
        return term

    def implication(self) -> Term:
        return self._nested(self._implication)

    def _implication(self) -> Term:
        start = self._column()
        term = self._chain(("or",), self._and, self.formula)
        if self._peek() == "->":
            self._next()
            self.formula(term, start, "left of '->'")
            start = self._column()
            term = Binary("->", term, self.formula(self.implication(), start, "right of '->'"))
        return term

    def _and(self) -> Term:
        return self._chain(("and",), self._until, self.formula)

    def _until(self) -> Term:
        start = self._column()
        term = self._unary()
        if self._peek() != "U":
            return term
        self._next()
        self.formula(term, start, "left of 'U'")
        low, high = self._bounds()
        start = self._column()
        return Binary("U", term, self.formula(self._nested(self._until), start, "right of 'U'"), low, high)

    def _unary(self) -> Term:
        op = self._peek()
        if op not in ("not", "G", "F"):
            return self._comparison()
        self._next()
        low, high = (0.0, math.inf) if op == "not" else self._bounds()
        start = self._column()
        return Unary(op, self.formula(self._nested(self._unary), start, f"right of '{op}'"), low, high)

    def _nested(self, part: Callable[[], Term]) -> Term:
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            self._fail(self._column(), f"formulas must be nested at most {_MAX_DEPTH} deep")
        term = part()
        self._depth -= 1
        return term

    def _bounds(self) -> tuple[float, float]:
        if self._peek() != "[":
            return 0.0, math.inf
        start = self._column()
        self._next()
        low = self._bound()
        self._expect(",")
        high = self._bound()
        self._expect("]")
        if not (low <= high and low < math.inf):
            self._fail(start, f"bounds must be 0 <= low <= high with low finite, but are [{low:g}, {high:g}]")
        return low, high

    def _bound(self) -> float:
        kind, text, column = self._next()
        if kind != "number" and text != "inf":
            self._fail(column, f"a bound must be a number of seconds >= 0 or inf, but is '{text}'")
        return float(text)

    def _comparison(self) -> Term:
        start = self._column()
        term = self._sum()
        if self._peek() not in _COMPARISONS:
            return term
        op = self._next()[1]
        self._number(term, start, f"left of '{op}'")
        start = self._column()
        term = Binary(op, term, self._number(self._sum(), start, f"right of '{op}'"))
        if self._peek() in _COMPARISONS:
            self._fail(self._column(), "comparisons must not be chained: write 'a < b and b < c'")
        return term

    def _sum(self) -> Term:
        return self._chain(("+", "-"), self._product, self._number)

    def _product(self) -> Term:
        return self._chain(("*", "/"), self._sign, self._number)

    def _sign(self) -> Term:
        kind, text, column = self._next()
        if text == "-":
            start = self._column()
            return Unary("neg", self._number(self._nested(self._sign), start, "right of '-'"))
        if kind == "number":
            if not math.isfinite(float(text)):
                self._fail(column, f"numbers must be finite, but there is {text}")
            return Number(float(text))
        if text == "(":
            term = self.implication()
            self._expect(")")
            return term
        if kind != "name" or text in _WORDS:
            self._fail(column, f"a signal, a number or '(' must be here, but there is '{text}'")
        try:
            self._check(text)
        except InputError as error:
            self._fail(column, str(error))
        return Signal(text)
