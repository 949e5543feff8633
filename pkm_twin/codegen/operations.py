# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Define each operation of programs: on floats, arrays and vector lanes, in C, its derivatives.

Operations are called like functions, on numbers, arrays or expressions. The back ends, the exported
C and the derivatives read everything about an operation from its :class:`Operation`.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from pkm_twin.codegen.assembly import Lanes, Value

CONSTANT_LEVEL: Final = 0
"""Level of an expression that depends on no input."""
PARAMETER_LEVEL: Final = 1
"""Level of an expression that depends on parameters only."""
SAMPLE_LEVEL: Final = 2
"""Level of an expression that depends on the sample."""

MAX_ANGLE: Final = 1e6
"""Largest angle of sine and cosine, rad; beyond it the reduction by quarter turns loses digits."""
MAX_QUARTER: Final = 1048576
"""More quarter turns than MAX_ANGLE has (2^20): added before truncation, it makes it a floor."""
# Minimax polynomials of sine and cosine up to a quarter turn, and pi / 2 in three parts
# (Cody and Waite 1980; coefficients of this file as in Cephes, public domain).
SINE: Final = (
    1.58962301576546568060e-10,
    -2.50507477628578072866e-8,
    2.75573136213857245213e-6,
    -1.98412698295895385996e-4,
    8.33333333332211858878e-3,
    -1.66666666666666307295e-1,
)
COSINE: Final = (
    -1.13585365213876817300e-11,
    2.08757008419747316778e-9,
    -2.75573141792967388112e-7,
    2.48015872888517045348e-5,
    -1.38888888888730564116e-3,
    4.16666666666665929218e-2,
)
HALF_PI: Final = (1.5707963267341256e00, 6.0771005065061922e-11, 2.0222662487959506e-21)
# Arctangent up to 0.66 as x + x z P(z) / Q(z), z = x^2.
ATAN_P: Final = (
    -8.750608600031904122785e-1,
    -1.615753718733365076637e1,
    -7.500855792314704667340e1,
    -1.228866684490136173410e2,
    -6.485021904942025371773e1,
)
ATAN_Q: Final = (
    1.0,
    2.485846490142306297962e1,
    1.650270098316988542046e2,
    4.328810604912902668951e2,
    4.853903996359136964868e2,
    1.945506571482613964425e2,
)
HALF_PI_REMAINDER: Final = 6.123233995736765886130e-17
"""Difference between pi / 2 and its nearest double."""
# The exponential function up to ln(2) / 2 as 1 + 2 x P(z) / (Q(z) - x P(z)), ln(2) in two parts.
EXP_P: Final = (1.26177193074810590878e-4, 3.02994407707441961300e-2, 9.99999999999999999910e-1)
EXP_Q: Final = (
    3.00198505138664455042e-6,
    2.52448340349684104192e-3,
    2.27265548208155028766e-1,
    2.0,
)
LN2: Final = (6.93145751953125e-1, 1.42860682030941723212e-6)
MAX_EXPONENT: Final = 745.2
"""Beyond this exponent (ln of the smallest double) the result is infinite, or zero if negative."""
# Hyperbolic tangent up to 0.625 as x + x z P(z) / Q(z).
TANH_P: Final = (-9.64399179425052238628e-1, -9.92877231001918586564e1, -1.61468768441708447952e3)
TANH_Q: Final = (1.0, 1.12811678491632931402e2, 2.23548839060100448583e3, 4.84406305325125486048e3)


def c_number(value: float) -> str:
    """Write a double as a C constant of exactly this value."""
    if not math.isfinite(value):
        return {math.inf: "HUGE_VAL", -math.inf: "(-HUGE_VAL)"}.get(value, "((double)NAN)")
    text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


@dataclass(frozen=True, eq=False, repr=False)
class Operation:
    """An operation on one to three arguments.

    ``numbers``: function of floats and arrays, used while a program is written. ``one``, ``many``:
    functions of floats and of arrays in a plain Python program, NaN or infinite where undefined; by
    default ``numbers``. ``slopes``: partial derivatives as a function of the result and the
    arguments. ``lanes``: LLVM instruction, or a function that writes several. ``infix``: format of
    the operation in Python and C; without it the operation is written as a function call: in C of
    ``c``, of the function of x, y and z that returns ``body``, or of math.h. ``folds``:
    simplification of the expression. ``commutes``: a op b = b op a.
    """

    name: str
    numbers: Callable[..., Any]
    lanes: str | Callable[..., Value]
    slopes: Callable[..., tuple[Any, ...]] = lambda e, *x: (0.0,) * len(x)
    one: Callable[..., Any] | None = None
    many: Callable[..., Any] | None = None
    infix: str = ""
    c: str = ""
    body: str = ""
    folds: Callable[..., Any] | None = None
    commutes: bool = False

    def __call__(self, *values: Any) -> Any:
        """Apply the operation to numbers, arrays or expressions."""
        for value in values:
            tape = getattr(value, "tape", None)
            if tape is not None:
                given = [tape.lift(x) for x in values]
                if any([x.level for x in given]):
                    return self.fold(*given)
                return tape.constant(float(self.numbers(*[x.value for x in given])))
        return self.numbers(*values)

    def fold(self, *given: Any) -> Any:
        """Record the operation on expressions, simplified if ``folds`` is given."""
        return given[0].tape.make(self, *given) if self.folds is None else self.folds(*given)

    def text(self, texts: Sequence[str], *, in_c: bool = False) -> str:
        """Write the operation on the texts of its arguments, in Python or in C."""
        infix = self.infix or (self.c if in_c and "{" in self.c else "")
        if infix:
            return infix.format(*texts)
        c = f"@_{self.name}" if self.body else self.c or self.name
        return f"{c if in_c else self.name}({', '.join(texts)})"

    @property
    def helper(self) -> str:
        """The C function that returns ``body``; empty without one."""
        names = ", ".join(f"double {x}" for x in "xyz" if re.search(rf"\b{x}\b", self.body))
        head = f"static double @_{self.name}({names})"
        return f"{head}\n{{\n    return {self.body};\n}}\n" if self.body else ""

    def __repr__(self) -> str:
        return self.name


def _fold_sum(a: Any, b: Any) -> Any:
    if a.level == CONSTANT_LEVEL and a.value == 0.0:
        return b
    if b.level == CONSTANT_LEVEL and b.value == 0.0:
        return a
    if b.op is neg:
        return _fold_difference(a, *b.args)
    return _fold_difference(b, *a.args) if a.op is neg else a.tape.make(add, a, b)


def _fold_difference(a: Any, b: Any) -> Any:
    if a is b:
        return a.tape.constant(0.0)
    if b.level == CONSTANT_LEVEL and b.value == 0.0:
        return a
    if a.level == CONSTANT_LEVEL and a.value == 0.0:
        return _fold_negation(b)
    if b.op is neg:
        return _fold_sum(a, *b.args)
    return _fold_negation(_fold_sum(a.args[0], b)) if a.op is neg else a.tape.make(sub, a, b)


def _fold_product(a: Any, b: Any) -> Any:
    for u, v in ((a, b), (b, a)):
        if u.level == CONSTANT_LEVEL and u.value in (0.0, 1.0, -1.0):
            return u if u.value == 0.0 else v if u.value > 0.0 else _fold_negation(v)
    if a.op is neg:
        both = b.op is neg
        return _fold_product(*a.args, *b.args) if both else _fold_negation(_fold_product(a.args[0], b))
    return _fold_negation(_fold_product(a, *b.args)) if b.op is neg else a.tape.make(mul, a, b)


def _fold_negation(a: Any) -> Any:
    if a.op is neg:
        return a.args[0]
    return _fold_difference(*a.args[::-1]) if a.op is sub else a.tape.make(neg, a)


def _fold_quotient(a: Any, b: Any) -> Any:
    """Record a quotient as a product with the reciprocal, which other quotients share."""
    if a.is_constant(0.0):
        return a
    if a.op is neg:
        return _fold_negation(_fold_quotient(a.args[0], b))
    return _fold_negation(_fold_quotient(a, *b.args)) if b.op is neg else _fold_product(a, inv(b))


def _closed_form_cosine_sine(e: Any) -> tuple[Any, Any] | None:
    """Return cosine and sine of a sum of arctangents in closed form; None for other expressions."""
    if e.op is atan2:
        y, x = e.args
        over = 1.0 / sqrt(x * x + y * y)
        return x * over, y * over
    if e.op is neg:
        inner = _closed_form_cosine_sine(*e.args)
        return inner and (inner[0], -inner[1])
    if e.op is not add and e.op is not sub:
        return None
    first, second = map(_closed_form_cosine_sine, e.args)
    if first is None or second is None:
        return None
    (c, s), (d, t) = first, second
    t = t if e.op is add else -t
    return c * d - s * t, s * d + c * t


def _define_angle_function(name: str, index: int, slope: Callable[[Any], Any]) -> Operation:
    """Define sine or cosine; compiled code computes both together."""
    numbers, within = getattr(np, name), getattr(math, name)

    def folds(x: Any) -> Any:
        circle = _closed_form_cosine_sine(x)
        return x.tape.make(turn, x) if circle is None else circle[index]

    def lanes(to: Lanes, e: Any, x: Value) -> Value:
        number = e.args[0].number
        if number not in to.cosine_sine:
            to.cosine_sine[number] = _write_cosine_sine(to, x)
        return to.cosine_sine[number][index]

    turn = Operation(
        name,
        numbers,
        lanes,
        lambda e, x: (slope(x),),
        lambda x: within(x) if abs(x) < MAX_ANGLE else math.nan,
        lambda x: numbers(np.where(np.abs(x) < MAX_ANGLE, x, np.nan)),
        folds=folds,
    )
    return turn


def _write_cosine_sine(to: Lanes, x: Value) -> tuple[Value, Value]:
    """Write cosine and sine in lanes."""
    b, n = to.function, to.number
    quarters = to.call("rint", b.fmul(x, n(2 / math.pi)))
    y = b.select(b.fcmp("olt", to.call("fabs", x), n(MAX_ANGLE)), x, n(math.nan))
    for part in HALF_PI:
        y = to.fused(quarters, n(-part), y)
    z = b.fmul(y, y)
    sine = to.fused(b.fmul(z, y), to.polynomial(z, SINE), y)
    cosine = b.fadd(to.fused(z, n(-0.5), n(1.0)), b.fmul(b.fmul(z, z), to.polynomial(z, COSINE)))
    k = b.fptosi(quarters, to.integer)
    odd = b.icmp("ne", b.and_(k, to.integer_constant(1)), to.integer_constant(0))

    def negate_by_quadrant(value: Value, quadrant: Value) -> Value:
        """Change the sign of a value where bit 1 of the quadrant's number is set."""
        flip = b.shl(b.and_(quadrant, to.integer_constant(2)), to.integer_constant(62))
        return b.bitcast(b.xor(b.bitcast(value, to.integer), flip), to.type)

    turned = negate_by_quadrant(b.select(odd, cosine, sine), k)
    return negate_by_quadrant(b.select(odd, sine, cosine), b.add(k, to.integer_constant(1))), turned


def _write_exponential(to: Lanes, x: Value) -> Value:
    b, n = to.function, to.number
    for bound, condition in ((n(MAX_EXPONENT), "ogt"), (n(-MAX_EXPONENT), "olt")):
        x = b.select(b.fcmp(condition, x, bound), bound, x)
    twos = to.call("rint", b.fmul(x, n(1.0 / math.log(2.0))))
    for part in LN2:
        x = to.fused(twos, n(-part), x)
    z = b.fmul(x, x)
    odd = b.fmul(x, to.polynomial(z, EXP_P))
    ratio = b.fdiv(odd, b.fsub(to.polynomial(z, EXP_Q), odd))
    result = to.fused(ratio, n(2.0), n(1.0))
    # Scale in two steps: 2^k alone may overflow or underflow where the result does not.
    half = to.call("rint", b.fmul(twos, n(0.5)))
    for share in (half, b.fsub(twos, half)):
        bits = b.shl(b.add(b.fptosi(share, to.integer), to.integer_constant(1023)), to.integer_constant(52))
        result = b.fmul(result, b.bitcast(bits, to.type))
    return result


def _saturating_exponential(x: float) -> float:
    try:
        return math.exp(x)
    except OverflowError:
        return math.inf


def _write_tanh(to: Lanes, e: Any, x: Value) -> Value:
    b, n = to.function, to.number
    size, z = to.call("fabs", x), b.fmul(x, x)
    ratio = b.fdiv(to.polynomial(z, TANH_P), to.polynomial(z, TANH_Q))
    power = _write_exponential(to, b.fmul(size, n(2.0)))
    large = b.fsub(n(1.0), b.fdiv(n(2.0), b.fadd(power, n(1.0))))
    small = b.fcmp("olt", size, n(0.625))
    return b.select(small, to.fused(b.fmul(x, z), ratio, x), to.call("copysign", large, x))


def _write_atan2(to: Lanes, e: Any, y: Value, x: Value) -> Value:
    b, n = to.function, to.number
    ay, ax = to.call("fabs", y), to.call("fabs", x)
    steep = b.fcmp("ogt", ay, ax)
    small, large = b.select(steep, ax, ay), b.select(steep, ay, ax)
    zero = b.fcmp("oeq", large, n(0.0))
    t = b.fdiv(small, b.select(zero, n(1.0), large))
    high = b.fcmp("ogt", t, n(0.66))
    u = b.select(high, b.fdiv(b.fsub(t, n(1.0)), b.fadd(t, n(1.0))), t)
    z = b.fmul(u, u)
    ratio = b.fdiv(to.polynomial(z, ATAN_P), to.polynomial(z, ATAN_Q))
    angle = to.fused(b.fmul(u, z), ratio, u)
    angle = b.select(high, b.fadd(b.fadd(angle, n(HALF_PI_REMAINDER / 2)), n(math.pi / 4)), angle)
    angle = b.select(steep, b.fadd(b.fsub(n(math.pi / 2), angle), n(HALF_PI_REMAINDER)), angle)
    back = b.icmp("slt", b.bitcast(x, to.integer), to.integer_constant(0))
    angle = b.select(back, b.fadd(b.fsub(n(math.pi), angle), n(2 * HALF_PI_REMAINDER)), angle)
    signs = b.and_(b.bitcast(y, to.integer), to.integer_constant(-(2**63)))
    return b.bitcast(b.or_(b.bitcast(angle, to.integer), signs), to.type)


def _write_sign(to: Lanes, e: Any, x: Value) -> Value:
    b, n = to.function, to.number
    down = b.select(b.fcmp("olt", x, n(0.0)), n(-1.0), b.fmul(x, n(0.0)))
    return b.select(b.fcmp("ogt", x, n(0.0)), n(1.0), down)


def _write_flag(to: Lanes, e: Any, mask: Value) -> Value:
    """Return 1.0 or 0.0; a following ``select`` uses the mask itself."""
    to.masks[e.number] = mask
    to.flags.add(e.number)
    return to.function.select(mask, to.number(1.0), to.number(0.0))


def _write_less(to: Lanes, e: Any, x: Value, y: Value) -> Value:
    return _write_flag(to, e, to.masks.get(e.number) or to.function.fcmp("olt", x, y))


def _write_select(to: Lanes, e: Any, x: Value, y: Value, z: Value) -> Value:
    where, value, other = e.args
    if where.number not in to.masks:
        to.masks[where.number] = to.function.fcmp("ogt", x, to.number(0.0))
    mask = to.masks[where.number]
    if value.number in to.flags and other.is_constant(0.0):
        return _write_flag(to, e, to.function.and_(mask, to.masks[value.number]))
    return to.function.select(mask, y, z)


def _fold_select(x: Any, y: Any, z: Any) -> Any:
    return (y if x.value > 0.0 else z) if x.level == CONSTANT_LEVEL else x.tape.make(select, x, y, z)


def _step_weight(a: Any, b: Any) -> Any:
    """Return 1 where a > b, 0 where a < b, 1/2 where a = b."""
    return 0.5 + 0.5 * sign(a - b)


def _sqrt_derivative(e: Any, x: Any) -> tuple[Any, ...]:
    # d sqrt(x) / dx = 1 / (2 sqrt(x)) is infinite at 0. Where the root is zero at the reference
    # geometry, x is a sum of squares with derivative 0 there: a bounded factor gives 0.
    return (0.5 / (maximum(e, 1e-150) if e.value == 0.0 else e),)


add: Final = Operation(
    "add",
    operator.add,
    "fadd",
    lambda e, a, b: (1.0, 1.0),
    infix="({} + {})",
    folds=_fold_sum,
    commutes=True,
)
sub: Final = Operation(
    "sub",
    operator.sub,
    "fsub",
    lambda e, a, b: (1.0, -1.0),
    infix="({} - {})",
    folds=_fold_difference,
)
mul: Final = Operation(
    "mul",
    operator.mul,
    "fmul",
    lambda e, a, b: (b, a),
    infix="({} * {})",
    folds=_fold_product,
    commutes=True,
)
neg: Final = Operation("neg", operator.neg, "fneg", lambda e, x: (-1.0,), infix="(-{})", folds=_fold_negation)
inv: Final[Operation] = Operation(
    "inv",
    lambda x: 1.0 / x,
    lambda to, e, x: to.function.fdiv(to.number(1.0), x),
    lambda e, x: (-(e * e),),
    lambda x: 1.0 / x if x else math.copysign(math.inf, x),
    c="(1.0 / {})",
    folds=lambda x: _fold_negation(inv(*x.args)) if x.op is neg else x.tape.make(inv, x),
)
divide: Final = Operation("divide", lambda a, b: a * (1.0 / b), "", folds=_fold_quotient)
sqrt: Final = Operation("sqrt", np.sqrt, "sqrt", _sqrt_derivative, lambda x: math.sqrt(x) if x >= 0.0 else math.nan)
sin: Final = _define_angle_function("sin", 1, lambda x: cos(x))
cos: Final[Operation] = _define_angle_function("cos", 0, lambda x: -sin(x))
exp: Final = Operation(
    "exp",
    np.exp,
    lambda to, e, x: _write_exponential(to, x),
    lambda e, x: (e,),
    _saturating_exponential,
)
tanh: Final = Operation("tanh", np.tanh, _write_tanh, lambda e, x: (1.0 - e * e,), math.tanh)
absolute: Final = Operation("abs", np.abs, "fabs", lambda e, x: (sign(x),), abs, c="fabs")
sign: Final[Operation] = Operation(
    "sign",
    np.sign,
    _write_sign,
    one=lambda x: 1.0 if x > 0.0 else -1.0 if x < 0.0 else x * 0.0,
    body="(x > 0.0) ? 1.0 : ((x < 0.0) ? -1.0 : x * 0.0)",
)
"""-1, 0 or 1."""
atan2: Final = Operation(
    "atan2",
    np.arctan2,
    _write_atan2,
    lambda e, y, x: (x / (y * y + x * x), -y / (y * y + x * x)),
    math.atan2,
    c="@_atan2",
)
minimum: Final = Operation(
    "min",
    np.minimum,
    lambda to, e, x, y: to.function.select(to.function.fcmp("olt", x, y), x, y),
    lambda e, x, y: (_step_weight(y, x), _step_weight(x, y)),
    lambda x, y: x if x < y else y,
    body="(x < y) ? x : y",
    commutes=True,
)
maximum: Final = Operation(
    "max",
    np.maximum,
    lambda to, e, x, y: to.function.select(to.function.fcmp("ogt", x, y), x, y),
    lambda e, x, y: (_step_weight(x, y), _step_weight(y, x)),
    lambda x, y: x if x > y else y,
    body="(x > y) ? x : y",
    commutes=True,
)
less: Final = Operation(
    "less",
    lambda x, y: np.where(x < y, 1.0, 0.0),
    _write_less,
    one=lambda x, y: 1.0 if x < y else 0.0,
    body="(x < y) ? 1.0 : 0.0",
)
"""1 where x < y, else 0, also if one of them is NaN."""
select: Final[Operation] = Operation(
    "select",
    lambda x, y, z: np.where(x > 0.0, y, z),
    _write_select,
    lambda e, x, y, z: (0.0, select(x, 1.0, 0.0), select(x, 0.0, 1.0)),
    lambda x, y, z: y if x > 0.0 else z,
    body="(x > 0.0) ? y : z",
    folds=_fold_select,
)
"""y where x > 0, else z."""
OPERATIONS: Final = (
    add,
    sub,
    mul,
    neg,
    inv,
    sqrt,
    sin,
    cos,
    exp,
    tanh,
    absolute,
    sign,
    atan2,
    minimum,
    maximum,
    less,
    select,
)


def both(x: Any, y: Any) -> Any:
    """Return 1 where both conditions (1 or 0) are 1, else 0."""
    return select(x, y, 0.0)


def fused(e: Any, used: Mapping[int, int], known: Container[int]) -> tuple[bool, Any, Any] | None:
    """Find a product that only the sum or difference ``e`` uses, so that both are one instruction.

    :param used: number of uses of each expression, see :func:`.expressions.count_uses`.
    :param known: numbers of the expressions that are computed elsewhere.
    :returns: whether the product is the first argument, the product, and the other argument; None
        if there is no such product.
    """
    if e.op is not add and e.op is not sub:
        return None
    for k, product in enumerate(e.args):
        once = product.op is mul and used.get(product.number, 2) == 1
        if once and product.number not in known:
            return k == 0, product, e.args[1 - k]
    return None
