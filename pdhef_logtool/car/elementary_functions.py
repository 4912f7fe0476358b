"""Arctangent and sine as polynomials, for inner loops over the sigma points of the filters.

The functions of the C library are scalar and would take most of a filter's time; these contain no branches and no
calls, so that the compiler generates vector instructions.
"""

import math

from pdhef_logtool.compiled.cache import inline

_TAN_PI_8 = 0.41421356237309503
_TAN_3_PI_8 = 2.414213562373095
_HALF_PI = 0.5 * math.pi
_QUARTER_PI = 0.25 * math.pi
_INVERSE_PI = 1.0 / math.pi
#: π in two parts: the double, and its rounding error.
_PI_REST = 1.2246467991473532e-16
#: Adding and subtracting this value rounds to the nearest integer.
_ROUND = 1.5 * 2.0**52


@inline
def arctangent(y, x):  # type: ignore[no-untyped-def]
    """Return atan(y / x) in rad for x > 0, to 3e-16.

    |y| / x is reduced below tan(π/8) by atan q = π/4 + atan((q − 1)/(q + 1)) or π/2 − atan(1/q), with one division.
    There, (atan(√z)/√z − 1)/z is a polynomial of degree 9, interpolated at the Chebyshev points of [0, tan²(π/8)] with
    60 digits, which is near the best of its degree (Trefethen 2013, chapter 16); its error is 6e-17.
    """
    a = abs(y)
    steep = a > _TAN_3_PI_8 * x
    middle = a > _TAN_PI_8 * x
    upper = -x if steep else (a - x if middle else a)
    lower = a if steep else (a + x if middle else x)
    base = _HALF_PI if steep else (_QUARTER_PI if middle else 0.0)
    t = upper / lower
    z = t * t
    z2 = z * z
    z4 = z2 * z2
    low = (-0.3333333333333325 + 0.19999999999898407 * z) + z2 * (-0.1428571426609662 + 0.11111109636534361 * z)
    middle_part = (-0.0909085255717602 + 0.07691055158392605 * z) + z2 * (
        -0.06649613695285927 + 0.05736332165872438 * z
    )
    high = -0.04483334622156894 + 0.022750526991774364 * z
    value = base + (t + t * z * (low + z4 * (middle_part + z4 * high)))
    return -value if y < 0.0 else value


@inline
def sine(x):  # type: ignore[no-untyped-def]
    """Return sin(x) for |x| up to 1e4 rad, to 3e-16.

    x is reduced to ±π/2 by multiples of π. There, (sin(√z)/√z − 1)/z is a polynomial of degree 7, found as in
    :func:`arctangent`; its error is 1e-18.
    """
    k = (x * _INVERSE_PI + _ROUND) - _ROUND
    odd = k - 2.0 * ((0.5 * k + _ROUND) - _ROUND)
    y = (x - k * math.pi) - k * _PI_REST
    z = y * y
    z2 = z * z
    low = (-0.16666666666666666 + 0.008333333333333316 * z) + z2 * (
        -0.00019841269841254974 + 2.7557319219163234e-06 * z
    )
    high = (-2.5052107616996182e-08 + 1.605897731246407e-10 * z) + z2 * (
        -7.64397029679794e-13 + 2.7314447669785093e-15 * z
    )
    value = y + y * z * (low + z2 * z2 * high)
    return value * (1.0 - 2.0 * odd * odd)
