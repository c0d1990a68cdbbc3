"""Arithmetic over named inputs from a configuration file, without running anybody's code.

>>> rule = Expression("v_ego - v_co < 30 and d_t > 0.5")
>>> rule({"v_ego": np.array([40.0, 90.0]), "v_co": np.array([30.0, 30.0]), "d_t": np.ones(2)}).tolist()
[True, False]
"""

from __future__ import annotations

import ast
import keyword
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from sbt.errors import InputError

__all__ = ["Expression"]

_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_COMPARE: dict[type, Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_EQUALITY: dict[type, Callable[[Any, Any], Any]] = {ast.Eq: operator.eq, ast.NotEq: operator.ne}
_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "abs": (1, np.abs), "sqrt": (1, np.sqrt), "exp": (1, np.exp), "log": (1, np.log), "sin": (1, np.sin),
    "cos": (1, np.cos), "min": (2, np.minimum), "max": (2, np.maximum),
}  # fmt: skip
"""name: number of arguments, and what it computes"""
_WORDS = ("and", "or", "not")


@dataclass(frozen=True)
class Expression:
    """A formula over inputs: + - * / **, comparisons, and, or, not, and a few functions.

    An input with choices is compared with one of them in quotes, by == or !=: `kind == "truck"`.

    Raises:
        InputError: the text is not such a formula.
    """

    text: str

    def __post_init__(self) -> None:
        both = [name for name, _ in self.choices() if name in self.numbers()]
        if both:
            rule = f"'{both[0]}' must be an input with choices (it is compared with a text) or a number"
            raise InputError(f"{rule}, but is both in '{self.text}'")
        with np.errstate(all="ignore"):
            _evaluate(self._tree(), self.example(), self.text)
            for node in ast.walk(self._tree()):
                if not isinstance(node, ast.BinOp) or any(isinstance(part, ast.Name) for part in ast.walk(node)):
                    continue
                if not np.isfinite(_evaluate(node, {}, self.text)):
                    raise InputError(f"a constant in '{self.text}' must be finite, but got {ast.unparse(node)}")

    def _tree(self) -> ast.expr:
        text = self.text.strip()
        try:
            tree = ast.parse(text, mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            reason = getattr(error, "msg", None) or str(error) or "nested too deeply"
            words = [word for word in re.findall(r"[A-Za-z_]\w*", self.text) if keyword.iskeyword(word) and word not in _WORDS]
            reason = f"'{words[0]}' is a word of Python, and no name for an input of a formula" if words else reason
            raise InputError(f"an expression must be a formula, but got '{self.text}' ({reason})") from None
        if not text.isascii():
            for node in ast.walk(tree):
                if isinstance(node, ast.Name):  # Python takes the micro sign for a Greek letter, an input's name has it
                    node.id = ast.get_source_segment(text, node) or node.id
        return tree

    def names(self) -> tuple[str, ...]:
        """Return the inputs that the formula uses, in order of appearance."""
        found = [n.id for n in ast.walk(self._tree()) if isinstance(n, ast.Name) and n.id not in _FUNCTIONS]
        return tuple(dict.fromkeys(found))

    @property
    def is_name(self) -> bool:
        """Whether it is an input alone, whose value may be a number or a choice."""
        return isinstance(self._tree(), ast.Name)

    def choices(self) -> tuple[tuple[str, str], ...]:
        """Return the inputs that are compared with a text, each with the text."""
        found = (_equality(node) for node in ast.walk(self._tree()))
        return tuple(dict.fromkeys((name, choice) for name, _, choice in filter(None, found)))

    def numbers(self) -> tuple[str, ...]:
        """Return the inputs that the formula uses as numbers."""
        tree = self._tree()
        compared = {id(part) for node in ast.walk(tree) if _equality(node) is not None for part in ast.walk(node)}
        used = [n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and n.id not in _FUNCTIONS and id(n) not in compared]
        return tuple(dict.fromkeys(used))

    def example(self) -> dict[str, Any]:
        """Return (1,) values of the inputs that the formula can be tried with."""
        return {**{name: np.array([""]) for name, _ in self.choices()}, **{name: np.ones(1) for name in self.numbers()}}

    def __call__(self, values: Mapping[str, Any]) -> Any:
        """Return the formula's value: (n,) for arrays of n values."""
        return _evaluate(self._tree(), values, self.text)


def _equality(node: ast.AST) -> tuple[str, type, str] | None:
    """Return input, operator and text of a comparison such as `kind == "truck"`; None for any other node."""
    match node:
        case ast.Compare(left=ast.Name(id=name), ops=[op], comparators=[ast.Constant(value=str(choice))]):
            return (name, type(op), choice) if type(op) in _EQUALITY else None
        case ast.Compare(left=ast.Constant(value=str(choice)), ops=[op], comparators=[ast.Name(id=name)]):
            return (name, type(op), choice) if type(op) in _EQUALITY else None
    return None


def _compared(name: str, operation: type, choice: str, values: Mapping[str, Any], text: str) -> Any:
    """Return whether an input is, or is not, this choice."""
    found = np.asarray(_evaluate(ast.Name(id=name), values, text))
    if found.dtype.kind not in "UO":
        raise InputError(f"'{name}' in '{text}' must be an input with choices, as it is compared with '{choice}'")
    return _EQUALITY[operation](found, choice)


def _evaluate(node: ast.expr, values: Mapping[str, Any], text: str) -> Any:
    """Return the value of one node of the syntax tree."""
    equality = _equality(node)
    if equality is not None:
        return _compared(*equality, values, text)
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return np.float64(value)
        case ast.Name(id=name):
            if name not in values:
                raise InputError(f"'{name}' in '{text}' must be an input, one of: {', '.join(values)}")
            return values[name]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_evaluate(operand, values, text)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return np.logical_not(_evaluate(operand, values, text))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            return _BINARY[type(op)](_evaluate(left, values, text), _evaluate(right, values, text))
        case ast.BoolOp(op=op, values=parts):
            join = np.logical_and if isinstance(op, ast.And) else np.logical_or
            return reduce(join, (_evaluate(part, values, text) for part in parts))
        case ast.Compare(left=left, ops=ops, comparators=rest) if all(type(o) in _COMPARE for o in ops):
            terms = [_evaluate(part, values, text) for part in (left, *rest)]
            pairs = zip(ops, terms[:-1], terms[1:], strict=True)
            return reduce(np.logical_and, (_COMPARE[type(o)](a, b) for o, a, b in pairs))
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS:
            count, function = _FUNCTIONS[name]
            if len(args) != count:
                raise InputError(f"{name}() in '{text}' takes {count} argument{'s' * (count > 1)}, but got {len(args)}")
            return function(*(_evaluate(arg, values, text) for arg in args))
    allowed = "numbers, inputs, + - * / **, comparisons, == 'choice', and, or, not, " + ", ".join(_FUNCTIONS)
    equal = isinstance(node, ast.Compare) and any(type(op) in _EQUALITY for op in node.ops)
    hint = "; that two numbers are equal is written as abs(a - b) < 0.5, with the distance that is meant" if equal else ""
    raise InputError(f"an expression may use {allowed}, but got '{text}'{hint}")
