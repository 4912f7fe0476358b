"""Conversions of MDF channels from raw to physical values; a formula of a file is parsed, never run as code.

A conversion is given as the block that ``asammdf`` has parsed. Source: ASAM MDF 4.2, CCBLOCK; MDF 3.3, CCBLOCK.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.signals import BoolArray, FloatArray

Values: TypeAlias = NDArray[Any]
#: Returns physical values [N] of raw numbers [N].
Rule: TypeAlias = Callable[[Values], FloatArray]

_LONGEST_FORMULA = 500
_DEEPEST_FORMULA = 40
_OPERATORS: Mapping[type[ast.AST], Callable[..., Any]] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power,
    ast.USub: np.negative, ast.UAdd: np.positive,
}  # fmt: skip
_FUNCTIONS: Mapping[str, np.ufunc] = {
    "abs": np.abs, "sqrt": np.sqrt, "exp": np.exp, "ln": np.log, "log": np.log, "log10": np.log10, "pow": np.power,
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan,
    "arcsin": np.arcsin, "arccos": np.arccos, "arctan": np.arctan, "atan2": np.arctan2,
    "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh,
}  # fmt: skip


def conversion_rule(block: Any, version: int) -> Rule:
    """Return the rule of a conversion block of MDF 3 or 4; ValueError if it is not supported."""
    if block is None:
        return _floats
    rules = _RULES_4 if version >= 4 else _RULES_3
    if block.conversion_type not in rules:
        raise ValueError(f"its conversion is of type {block.conversion_type}, which is not supported")
    try:
        return rules[block.conversion_type](block)
    except AttributeError:  # what asammdf has not found in a damaged block
        raise ValueError("its conversion is incomplete") from None


def formula_rule(text: str) -> Rule:
    """Return the rule of a formula in X or X1: numbers, ``+ - * / ** ^`` (power) and some functions.

    Raises
    ------
    ValueError : the formula contains anything else.
    """
    text = text.partition("\0")[0].strip()
    shown = text if len(text) <= 40 else f"{text[:40]}..."
    if len(text) > _LONGEST_FORMULA:
        raise ValueError(f"its formula {shown!r} is longer than {_LONGEST_FORMULA} characters")
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
            case ast.Constant(value=int() | float() as number):
                return np.float64(number)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(operand))
            case ast.BinOp(op=op, left=left, right=right) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(left), value(right))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in _FUNCTIONS:
                if len(arguments) == _FUNCTIONS[name].nin:
                    return _FUNCTIONS[name](*map(value, arguments))
    raise ValueError(ast.dump(node)[:80])


def _floats(raw: Values) -> FloatArray:
    return raw.astype(np.float64)


def _parameters(block: Any, count: int) -> list[np.float64]:
    return [np.float64(getattr(block, f"P{i}")) for i in range(1, count + 1)]


def _column(block: Any, name: str, count: int) -> FloatArray:
    return np.asarray([getattr(block, f"{name}_{i}") for i in range(count)], np.float64)


def _linear(block: Any) -> Rule:
    return lambda raw: _floats(raw) * block.a + block.b


def _rational(block: Any) -> Rule:
    p1, p2, p3, p4, p5, p6 = _parameters(block, 6)

    def convert(raw: Values) -> FloatArray:
        x = _floats(raw)
        with np.errstate(all="ignore"):
            return np.asarray(((p1 * x + p2) * x + p3) / ((p4 * x + p5) * x + p6))

    return convert


def _polynomial(block: Any) -> Rule:
    p1, p2, p3, p4, p5, p6 = _parameters(block, 6)

    def convert(raw: Values) -> FloatArray:
        x = _floats(raw) - p5 - p6
        with np.errstate(all="ignore"):
            return np.asarray((p2 - p4 * x) / (p3 * x - p1))

    return convert


def _transcendental(function: np.ufunc, block: Any) -> Rule:
    """Return the rule of an exponential (``exp``) or logarithmic (``log``) conversion."""
    p1, p2, p3, p4, p5, p6, p7 = _parameters(block, 7)
    if (p1 == 0.0) == (p4 == 0.0):
        raise ValueError("its exponential or logarithmic conversion needs either P1 or P4")

    def convert(raw: Values) -> FloatArray:
        x = _floats(raw) - p7
        with np.errstate(all="ignore"):
            values = function((p3 / x - p6) / p4) / p5 if p1 == 0.0 else function((x * p6 - p3) / p1) / p2
        return np.asarray(values)

    return convert


def _table(interpolates: bool, values_of_a_pair: int, block: Any) -> Rule:
    """Return the rule of a table: interpolated, or the value of the nearest key, of two equally near the lower."""
    count = (block.val_param_nr if values_of_a_pair == 2 else block.ref_param_nr) // values_of_a_pair
    keys, values = _column(block, "raw", count), _column(block, "phys", count)
    if not count or np.isnan(keys).any():
        raise ValueError("its conversion table has no keys")
    order = np.argsort(keys, kind="stable")
    keys, values = keys[order], values[order]
    if interpolates:
        return lambda raw: np.interp(_floats(raw), keys, values)
    borders = (keys[1:] + keys[:-1]) / 2.0
    return lambda raw: np.where(np.isnan(_floats(raw)), np.nan, values[np.searchsorted(borders, _floats(raw))])


def _inside(raw: Values, low: float, high: float) -> BoolArray:
    """Return which raw values [N] are in a range; its end belongs to a range of integers."""
    is_end = (raw == high) & (raw.dtype.kind != "f" or low == high)
    return np.asarray((raw >= low) & (raw < high) | is_end)


def _ranges(block: Any) -> Rule:
    count = (block.val_param_nr - 1) // 3
    lows, highs, values = (_column(block, name, count).tolist() for name in ("lower", "upper", "phys"))

    def convert(raw: Values) -> FloatArray:
        result = np.where(np.isnan(_floats(raw)), np.nan, np.float64(block.default))
        for low, high, value in zip(lows, highs, values, strict=True):
            result[_inside(raw, low, high)] = value
        return result

    return convert


def _texts_4(is_range: bool, block: Any) -> Rule:
    count = block.val_param_nr // (2 if is_range else 1)
    names = ("lower", "upper") if is_range else ("val", "val")
    lows, highs = (_column(block, name, count).tolist() for name in names)
    blocks = [block.referenced_blocks.get(key) for key in (*(f"text_{i}" for i in range(count)), "default_addr")]
    *rules, default = (None if isinstance(b, bytes | None) else conversion_rule(b, 4) for b in blocks)
    return _texts(list(zip(lows, highs, rules, strict=True)), default)


def _text_ranges_3(block: Any) -> Rule:
    """Return the rule of a table of texts, whose default text may contain a formula of ``{X}``."""
    default = block.referenced_blocks.get("default_addr") or b""
    if b"{X}" not in default:
        return _floats
    count = block.ref_param_nr - 1
    lows, highs = (_column(block, name, count).tolist() for name in ("lower", "upper"))
    formula = default.decode("latin-1").replace("{X}", "X").strip('\0 "')
    return _texts([(low, high, None) for low, high in zip(lows, highs, strict=True)], formula_rule(formula))


def _texts(entries: list[tuple[float, float, Rule | None]], default: Rule | None) -> Rule:
    """Return the rule of a table of texts: raw numbers, or NaN for texts that replace some of the numbers."""
    if default is None and not any(rule for _, _, rule in entries):
        return _floats

    def convert(raw: Values) -> FloatArray:
        result = default(raw) if default else np.full(raw.shape, np.nan)
        for low, high, rule in reversed(entries):
            its = _inside(raw, low, high)
            result[its] = rule(raw[its]) if rule else np.nan
        return result

    return convert


def _as_is(_: Any) -> Rule:
    return _floats


def _formula(block: Any) -> Rule:
    return formula_rule(str(block.formula))


_RULES_4: Mapping[int, Callable[[Any], Rule]] = {
    0: _as_is, 1: _linear, 2: _rational, 3: _formula, 4: partial(_table, True, 2), 5: partial(_table, False, 2),
    6: _ranges, 7: partial(_texts_4, False), 8: partial(_texts_4, True), 11: _as_is,
}  # fmt: skip
_RULES_3: Mapping[int, Callable[[Any], Rule]] = {
    0: _linear, 1: partial(_table, True, 1), 2: partial(_table, False, 1), 6: _polynomial,
    7: partial(_transcendental, np.exp), 8: partial(_transcendental, np.log), 9: _rational, 10: _formula,
    11: _as_is, 12: _text_ranges_3, 65535: _as_is,
}  # fmt: skip
