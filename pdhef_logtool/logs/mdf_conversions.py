"""Conversions of MDF channels from raw to physical values; a formula of a file is parsed, never run as code.

``block`` is a conversion block as ``asammdf`` has parsed it. Source: ASAM MDF 4.2 and MDF 3.3, CCBLOCK. The
exponential and logarithmic types of MDF 3 are not supported, as readers disagree on which is which.
"""

import ast
from collections.abc import Callable, Sequence
from functools import partial
from itertools import count, takewhile
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.constants import CONSTANTS, numbered
from pdhef_logtool.records.signals import FloatArray

#: Returns physical values [N] of raw numbers [N].
Rule: TypeAlias = Callable[[NDArray[Any]], FloatArray]

_LONGEST_FORMULA, _DEEPEST_FORMULA, _SHOWN_CHARACTERS = 500, 40, 40
_OPERATORS: dict[type[ast.AST], np.ufunc] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power,
    ast.USub: np.negative, ast.UAdd: np.positive,
}  # fmt: skip
_NAMES = "abs sqrt exp log log10 sin cos tan arcsin arccos arctan arctan2 sinh cosh tanh"
_FUNCTIONS: dict[str, np.ufunc] = {name: getattr(np, name) for name in _NAMES.split()} | {
    "ln": np.log, "pow": np.power, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2,
}  # fmt: skip

#: Conversions that are formulas of their parameters, and names of the others, by version and type.
_FORMULAS, _OTHERS = (
    {version: numbered(kinds) for version, kinds in CONSTANTS["mdf"][name].items()} for name in ("formulas", "tables")
)


def conversion_rule(block: Any, version: int) -> Rule:
    """Return the rule of a conversion block of MDF 3 or 4; ValueError if it is not supported."""
    if block is None:
        return _floats
    number, type_ = str(version), block.conversion_type
    try:
        if formula := _FORMULAS[number].get(type_):
            return formula_rule(formula.format(block))
        match kind := _OTHERS[number].get(type_):
            case "interpolated" | "nearest":
                return _table(block, interpolates=kind == "interpolated")
            case "formulas":
                values = [formula_rule(str(value)) for value in _column(block, "phys")]
                return _pieces(block, values, formula_rule(str(block.default)))
            case "texts":
                blocks = block.referenced_blocks.items()
                rules = {key: None if isinstance(b, bytes | None) else conversion_rule(b, version) for key, b in blocks}
                default = rules.pop("default_addr", None)
                return _pieces(block, [*rules.values()], default)
            case "ranges":  # the text of all other numbers may contain a formula of {X}
                text = (block.referenced_blocks.get("default_addr") or b"").decode("latin-1")
                default = formula_rule(text.replace("{X}", "x").strip('\0 "')) if "{X}" in text else None
                return _pieces(block, [None] * len(_column(block, "lower")), default)
    except AttributeError:  # of a block that asammdf has not read to its end
        raise ValueError("its conversion is incomplete") from None
    raise ValueError(f"its conversion is of type {type_}, which is not supported")


def formula_rule(text: str) -> Rule:
    """Return the rule of a formula in X or X1: numbers, ``+ - * / ** ^`` (power) and some functions.

    Raises
    ------
    ValueError : the formula contains anything else.
    """
    text = text.partition("\0")[0].strip()
    shown = text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}..."
    if len(text) > _LONGEST_FORMULA:
        raise ValueError(f"its formula {shown!r} has more than {_LONGEST_FORMULA} characters")
    try:
        tree = ast.parse(text.lower().replace("^", "**"), mode="eval").body
        _evaluated(tree, np.empty(0), 0)
    except (SyntaxError, ValueError, TypeError, OverflowError, RecursionError, MemoryError):
        raise ValueError(f"its formula {shown!r} is no arithmetic of X") from None
    return lambda raw: np.array(np.broadcast_to(_evaluated(tree, _floats(raw), 0), raw.shape))


def _evaluated(node: ast.AST, x: FloatArray, depth: int) -> Any:
    """Return the value of a node of a formula; ValueError for a node that is no arithmetic."""
    value = partial(_evaluated, x=x, depth=depth + 1)
    if depth > _DEEPEST_FORMULA:
        raise ValueError("too deep")
    with np.errstate(all="ignore"):
        match node:
            case ast.Name(id="x" | "x1"):
                return x
            case ast.Name(id="nan" | "inf" as name):
                return np.float64(name)
            case ast.Constant(value=int() | float() as number):
                return np.float64(number)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(operand))
            case ast.BinOp(op=op, left=left, right=right) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(left), value(right))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in _FUNCTIONS:
                if len(arguments) == _FUNCTIONS[name].nin:
                    return _FUNCTIONS[name](*map(value, arguments))
    raise ValueError(node)


def _floats(raw: NDArray[Any]) -> FloatArray:
    return raw.astype(np.float64)


def _column(block: Any, name: str) -> list[float]:
    """Return the numbers of a table: attributes ``name_0``, ``name_1``, ..."""
    places = takewhile(lambda i: hasattr(block, f"{name}_{i}"), count())
    return [float(getattr(block, f"{name}_{i}")) for i in places]


def _table(block: Any, *, interpolates: bool) -> Rule:
    """Return the rule of a table: interpolated, or the value of the nearest key, of two equally near the lower."""
    keys, values = np.asarray(_column(block, "raw")), np.asarray(_column(block, "phys"))
    if not len(keys) or np.isnan(keys).any():
        raise ValueError("its conversion table has no keys")
    order = np.argsort(keys, kind="stable")
    keys, values = keys[order], values[order]
    if interpolates:
        return lambda raw: np.interp(_floats(raw), keys, values)
    borders = (keys[1:] + keys[:-1]) / 2.0
    return lambda raw: np.where(np.isnan(_floats(raw)), np.nan, values[np.searchsorted(borders, _floats(raw))])


def _pieces(block: Any, rules: Sequence[Rule | None], default: Rule | None) -> Rule:
    """Return the rule of values or ranges with a rule each, and of a default for all other numbers; None is a text.

    The end of a range belongs to a range of integers. Texts are NaN if other numbers have a rule; otherwise all numbers
    stay as they are.
    """
    if default is None and not any(rules):
        return _floats
    lows, highs = (_column(block, "val") or _column(block, name) for name in ("lower", "upper"))

    def convert(raw: NDArray[Any]) -> FloatArray:
        values = default(raw) if default else np.full(raw.shape, np.nan)
        for first, last, rule in reversed([*zip(lows, highs, rules, strict=True)]):
            its = (raw >= first) & (raw < last) | (raw == last) & (raw.dtype.kind != "f" or first == last)
            values[its] = rule(raw[its]) if rule else np.nan
        return values

    return convert
