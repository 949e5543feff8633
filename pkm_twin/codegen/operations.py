# SPDX-License-Identifier: Apache-2.0
"""Every operation of programs in one place: on floats, arrays and vector lanes, in C, its slopes.

An operation is called like a function, on numbers, arrays or expressions. Another one is a class
here: the back ends, the exported C and the derivatives take it from here.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Container, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

if TYPE_CHECKING:
    from pkm_twin.codegen.assembly import Value
    from pkm_twin.codegen.lanes import Lanes

CONSTANT: Final = 0
PARAMETER: Final = 1
SAMPLE: Final = 2
"""What an expression hangs on: nothing, the parameters alone, or the sample."""

MAX_ANGLE: Final = 1e6
"""Sines and cosines of larger angles, rad, are NaN: the reduction by quarter turns loses digits."""
QUARTERS: Final = 1048576
"""More quarter turns than that angle has: what is above zero is truncated downwards."""
# Minimax polynomials of sine and cosine up to a quarter turn, and pi / 2 in three parts
# (Cody and Waite 1980; coefficients of this file as in Cephes, public domain).
SINE: Final = (
    1.58962301576546568060e-10, -2.50507477628578072866e-8, 2.75573136213857245213e-6,
    -1.98412698295895385996e-4, 8.33333333332211858878e-3, -1.66666666666666307295e-1,
)  # fmt: skip
COSINE: Final = (
    -1.13585365213876817300e-11, 2.08757008419747316778e-9, -2.75573141792967388112e-7,
    2.48015872888517045348e-5, -1.38888888888730564116e-3, 4.16666666666665929218e-2,
)  # fmt: skip
QUARTER: Final = (1.5707963267341256e00, 6.0771005065061922e-11, 2.0222662487959506e-21)
# Arctangent up to 0.66 as x + x z P(z) / Q(z), z = x^2.
ATAN_P: Final = (
    -8.750608600031904122785e-1, -1.615753718733365076637e1, -7.500855792314704667340e1,
    -1.228866684490136173410e2, -6.485021904942025371773e1,
)  # fmt: skip
ATAN_Q: Final = (
    1.0, 2.485846490142306297962e1, 1.650270098316988542046e2, 4.328810604912902668951e2,
    4.853903996359136964868e2, 1.945506571482613964425e2,
)  # fmt: skip
MORE: Final = 6.123233995736765886130e-17
"""pi / 2 less its nearest double."""
# The exponential function up to ln(2) / 2 as 1 + 2 x P(z) / (Q(z) - x P(z)), ln(2) in two parts.
EXP_P: Final = (1.26177193074810590878e-4, 3.02994407707441961300e-2, 9.99999999999999999910e-1)
EXP_Q: Final = (
    3.00198505138664455042e-6, 2.52448340349684104192e-3, 2.27265548208155028766e-1, 2.0,
)  # fmt: skip
LN2: Final = (6.93145751953125e-1, 1.42860682030941723212e-6)
LARGEST_POWER: Final = 745.2
"""The exponential function of more is infinite, of less than minus this zero."""
# Hyperbolic tangent up to 0.625 as x + x z P(z) / Q(z).
TANH_P: Final = (-9.64399179425052238628e-1, -9.92877231001918586564e1, -1.61468768441708447952e3)
TANH_Q: Final = (1.0, 1.12811678491632931402e2, 2.23548839060100448583e3, 4.84406305325125486048e3)


def c_number(value: float) -> str:
    """A double as C has it, exactly."""
    if not math.isfinite(value):
        return {math.inf: "HUGE_VAL", -math.inf: "(-HUGE_VAL)"}.get(value, "((double)NAN)")
    text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


def _series(coefficients: Sequence[float]) -> str:
    text = c_number(coefficients[0])
    for c in coefficients[1:]:
        text = f"PKM_FMA({text}, z,\n        {c_number(c)})"
    return text


class Operation:
    """An operation on one to three arguments.

    ``infix``: of it on texts, else it is a function: ``name`` in Python; in C ``body`` is what
    @_name(x, y, z) returns, or it is math.h's ``c``. ``instruction``: LLVM's, or its intrinsic
    function. ``numbers``: on floats and arrays, for what is computed while a program is written.
    ``one``, ``many``: on floats and on arrays, in a program: NaN or infinite without a result.
    """

    name: ClassVar[str]
    infix: ClassVar[str] = ""
    c: ClassVar[str] = ""
    body: ClassVar[str] = ""
    instruction: ClassVar[str] = ""
    commutes: ClassVar[bool] = False
    numbers: ClassVar[Any]
    one: ClassVar[Any]
    many: ClassVar[Any]

    def __call__(self, *values: Any) -> Any:
        """The operation on numbers, arrays or expressions, folded where it can be."""
        for value in values:
            tape = getattr(value, "tape", None)
            if tape is not None:
                given = [tape.lift(x) for x in values]
                if any([x.level for x in given]):
                    return self.fold(*given)
                return tape.constant(float(self.numbers(*[x.value for x in given])))
        return self.numbers(*values)

    def fold(self, *given: Any) -> Any:
        """An expression of the same value, by default the operation itself."""
        return given[0].tape.make(self, *given)

    def in_python(self, texts: Sequence[str]) -> str:
        """The operation on what these texts say."""
        return self.infix.format(*texts) if self.infix else f"{self.name}({', '.join(texts)})"

    def in_c(self, texts: Sequence[str]) -> str:
        """The same in C."""
        if self.infix:
            return self.infix.format(*texts)
        return f"{f'@_{self.name}' if self.body else self.c or self.name}({', '.join(texts)})"

    @property
    def helper(self) -> str:
        """A C function that :meth:`in_c` calls; there may be none."""
        names = ", ".join(f"double {x}" for x in "xyz" if re.search(rf"\b{x}\b", self.body))
        head = f"static double @_{self.name}({names})"
        return f"{head}\n{{\n    return {self.body};\n}}\n" if self.body else ""

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        """Its instructions on vectors, or on one double."""
        return to.instruction(self.instruction, *x)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        """Derivatives of its value ``e`` by the arguments, expressions or numbers."""
        return (0.0,) * len(x)

    def __repr__(self) -> str:
        return self.name


class _Add(Operation):
    name, infix, instruction, commutes = "add", "({} + {})", "fadd", True
    numbers = one = many = operator.add

    def fold(self, a: Any, b: Any) -> Any:
        if a.level == CONSTANT and a.value == 0.0:
            return b
        if b.level == CONSTANT and b.value == 0.0:
            return a
        if b.op is neg:
            return sub.fold(a, *b.args)
        if a.op is neg:
            return sub.fold(b, *a.args)
        return a.tape.make(self, a, b)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return 1.0, 1.0


class _Sub(Operation):
    name, infix, instruction = "sub", "({} - {})", "fsub"
    numbers = one = many = operator.sub

    def fold(self, a: Any, b: Any) -> Any:
        if a is b:
            return a.tape.constant(0.0)
        if b.level == CONSTANT and b.value == 0.0:
            return a
        if a.level == CONSTANT and a.value == 0.0:
            return neg.fold(b)
        if b.op is neg:
            return add.fold(a, *b.args)
        if a.op is neg:
            return neg.fold(add.fold(a.args[0], b))
        return a.tape.make(self, a, b)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return 1.0, -1.0


class _Mul(Operation):
    name, infix, instruction, commutes = "mul", "({} * {})", "fmul", True
    numbers = one = many = operator.mul

    def fold(self, a: Any, b: Any) -> Any:
        for u, v in ((a, b), (b, a)):
            if u.level == CONSTANT and u.value in (0.0, 1.0, -1.0):
                return u if u.value == 0.0 else v if u.value > 0.0 else neg.fold(v)
        if a.op is neg:
            positive = b.op is neg
            return mul.fold(*a.args, *b.args) if positive else neg.fold(mul.fold(a.args[0], b))
        if b.op is neg:
            return neg.fold(mul.fold(a, *b.args))
        return a.tape.make(self, a, b)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return x[1], x[0]


class _Neg(Operation):
    name, infix, instruction = "neg", "(-{})", "fneg"
    numbers = one = many = operator.neg

    def fold(self, a: Any) -> Any:
        if a.op is neg:
            return a.args[0]
        return sub.fold(*a.args[::-1]) if a.op is sub else a.tape.make(self, a)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return (-1.0,)


class _Inv(Operation):
    name = "inv"

    @staticmethod
    def numbers(x: Any) -> Any:
        return 1.0 / x

    many = numbers

    @staticmethod
    def one(x: float) -> float:
        return 1.0 / x if x else math.copysign(math.inf, x)

    def fold(self, a: Any) -> Any:
        return neg.fold(inv.fold(*a.args)) if a.op is neg else a.tape.make(self, a)

    def in_c(self, texts: Sequence[str]) -> str:
        return f"(1.0 / {texts[0]})"

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        return to.b.fdiv(to.number(1.0), *x)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return (-(e * e),)


class _Divide(Operation):
    """A quotient, as a product with a reciprocal, which is shared."""

    @staticmethod
    def numbers(a: float, b: float) -> float:
        return a * (1.0 / b)

    def fold(self, a: Any, b: Any) -> Any:
        if a.is_constant(0.0):
            return a
        if a.op is neg:
            return neg.fold(self.fold(a.args[0], b))
        if b.op is neg:
            return neg.fold(self.fold(a, *b.args))
        return mul.fold(a, inv(b))


class _Sqrt(Operation):
    name = instruction = "sqrt"
    numbers = many = np.sqrt

    @staticmethod
    def one(x: float) -> float:
        return math.sqrt(x) if x >= 0.0 else math.nan

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        # The length of a vector that is zero has no slope; where it counts, a greater length does.
        # Of one that is zero in the known case, its square has none there either.
        return (0.5 / (maximum(e, _LEAST) if e.value == 0.0 else e),)


class _Turn(Operation):
    """Sine or cosine, each with the other computed at once."""

    index: ClassVar[int]
    within: ClassVar[Any]
    helper = f"""\
/* Sines and cosines: polynomials after Cody and Waite's reduction by quarter turns. NaN where
   the angle is so large that the reduction loses digits. */
static void @_turn(const double *x, double *s, double *c, int count)
{{
    int i;
    for (i = 0; i < count; i++) {{
        const double angle = (fabs(x[i]) < {MAX_ANGLE!r}) ? x[i] : 0.0;
        const int k = (int)((angle * {c_number(2.0 / math.pi)}) + {QUARTERS}.5) - {QUARTERS};
        const double n = -(double)k;
        const double y = PKM_FMA(n, {c_number(QUARTER[2])},
            PKM_FMA(n, {c_number(QUARTER[1])}, PKM_FMA(n, {c_number(QUARTER[0])}, angle)));
        const double z = y * y;
        const double sine = PKM_FMA(z * y, {_series(SINE)}, y);
        const double cosine = PKM_FMA(z, -0.5, 1.0) + (z * z) * {_series(COSINE)};
        const int even = 1 - (k & 1);
        const int side = 1 - (k & 2);
        const double u = (double)(even * side);
        const double v = (double)((1 - even) * side);
        s[i] = PKM_FMA(u, sine, v * cosine);
        c[i] = PKM_FMA(u, cosine, -(v * sine));
    }}
    for (i = 0; i < count; i++) {{
        if (!(fabs(x[i]) < {MAX_ANGLE!r})) {{
            s[i] = c[i] = (double)NAN;
        }}
    }}
}}
"""

    def fold(self, *given: Any) -> Any:
        circle = _circle(*given)
        return super().fold(*given) if circle is None else circle[self.index]

    @classmethod
    def one(cls, x: float) -> float:
        return float(cls.within(x)) if abs(x) < MAX_ANGLE else math.nan

    @classmethod
    def many(cls, x: Any) -> Any:
        return cls.numbers(np.where(np.abs(x) < MAX_ANGLE, x, np.nan))

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        number = e.args[0].number
        if number not in to.turned:
            to.turned[number] = self._both(to, *x)
        return to.turned[number][self.index]

    @staticmethod
    def _both(to: Lanes, x: Value) -> tuple[Value, Value]:
        """Cosine and sine."""
        b, n = to.b, to.number
        quarters = to.call("rint", b.fmul(x, n(2 / math.pi)))
        y = b.select(b.fcmp("olt", to.call("fabs", x), n(MAX_ANGLE)), x, n(math.nan))
        for part in QUARTER:
            y = to.fused(quarters, n(-part), y)
        z = b.fmul(y, y)
        sine = to.fused(b.fmul(z, y), to.polynomial(z, SINE), y)
        cosine = b.fadd(
            to.fused(z, n(-0.5), n(1.0)), b.fmul(b.fmul(z, z), to.polynomial(z, COSINE))
        )
        k = b.fptosi(quarters, to.integer)
        odd = b.icmp("ne", b.and_(k, to.whole(1)), to.whole(0))

        def signed(value: Value, turns: Value) -> Value:
            flip = b.shl(b.and_(turns, to.whole(2)), to.whole(62))
            return b.bitcast(b.xor(b.bitcast(value, to.integer), flip), to.type)

        turned = signed(b.select(odd, cosine, sine), k)
        return signed(b.select(odd, sine, cosine), b.add(k, to.whole(1))), turned


class _Sin(_Turn):
    name, index, numbers, within = "sin", 1, np.sin, math.sin

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return (cos(*x),)


class _Cos(_Turn):
    name, index, numbers, within = "cos", 0, np.cos, math.cos

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return (-sin(*x),)


def _circle(e: Any) -> tuple[Any, Any] | None:
    """Cosine and sine of an arctangent, or of a sum of arctangents, without computing an angle."""
    if e.op is atan2:
        y, x = e.args
        over = 1.0 / sqrt(x * x + y * y)
        return x * over, y * over
    if e.op is neg:
        inner = _circle(*e.args)
        return inner and (inner[0], -inner[1])
    if e.op is not add and e.op is not sub:
        return None
    first, second = map(_circle, e.args)
    if first is None or second is None:
        return None
    (c, s), (d, t) = first, second
    t = t if e.op is add else -t
    return c * d - s * t, s * d + c * t


class _Exp(Operation):
    name, numbers, many = "exp", np.exp, np.exp

    @staticmethod
    def one(x: float) -> float:
        try:
            return math.exp(x)
        except OverflowError:
            return math.inf

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        b, n, power = to.b, to.number, x[0]
        for bound, condition in ((n(LARGEST_POWER), "ogt"), (n(-LARGEST_POWER), "olt")):
            power = b.select(b.fcmp(condition, power, bound), bound, power)
        twos = to.call("rint", b.fmul(power, n(1.0 / math.log(2.0))))
        for part in LN2:
            power = to.fused(twos, n(-part), power)
        z = b.fmul(power, power)
        odd = b.fmul(power, to.polynomial(z, EXP_P))
        ratio = b.fdiv(odd, b.fsub(to.polynomial(z, EXP_Q), odd))
        result = to.fused(ratio, n(2.0), n(1.0))
        # In two parts: 2^k alone may be infinite, or zero, where the result is not.
        half = to.call("rint", b.fmul(twos, n(0.5)))
        for share in (half, b.fsub(twos, half)):
            bits = b.shl(b.add(b.fptosi(share, to.integer), to.whole(1023)), to.whole(52))
            result = b.fmul(result, b.bitcast(bits, to.type))
        return result

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return (e,)


class _Tanh(Operation):
    name, numbers, many, one = "tanh", np.tanh, np.tanh, math.tanh

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        b, n, (y,) = to.b, to.number, x
        size, z = to.call("fabs", y), b.fmul(y, y)
        ratio = b.fdiv(to.polynomial(z, TANH_P), to.polynomial(z, TANH_Q))
        power = exp.lanes(to, None, b.fmul(size, n(2.0)))
        large = b.fsub(n(1.0), b.fdiv(n(2.0), b.fadd(power, n(1.0))))
        small = b.fcmp("olt", size, n(0.625))
        return b.select(small, to.fused(b.fmul(y, z), ratio, y), to.call("copysign", large, y))

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return (1.0 - e * e,)


class _Abs(Operation):
    name, c, instruction = "abs", "fabs", "fabs"
    numbers, many, one = np.abs, np.abs, abs

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return (sign(*x),)


class _Sign(Operation):
    """-1, 0 or 1."""

    name, numbers, many = "sign", np.sign, np.sign
    body = "(x > 0.0) ? 1.0 : ((x < 0.0) ? -1.0 : x * 0.0)"

    @staticmethod
    def one(x: float) -> float:
        return 1.0 if x > 0.0 else -1.0 if x < 0.0 else x * 0.0

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        b, n, (y,) = to.b, to.number, x
        down = b.select(b.fcmp("olt", y, n(0.0)), n(-1.0), b.fmul(y, n(0.0)))
        return b.select(b.fcmp("ogt", y, n(0.0)), n(1.0), down)


class _Atan2(Operation):
    """The angle of (x, y)."""

    name, numbers, many, one = "atan2", np.arctan2, np.arctan2, math.atan2

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        b, n, (down, right) = to.b, to.number, x
        ay, ax = to.call("fabs", down), to.call("fabs", right)
        steep = b.fcmp("ogt", ay, ax)
        small, large = b.select(steep, ax, ay), b.select(steep, ay, ax)
        zero = b.fcmp("oeq", large, n(0.0))
        t = b.fdiv(small, b.select(zero, n(1.0), large))
        high = b.fcmp("ogt", t, n(0.66))
        u = b.select(high, b.fdiv(b.fsub(t, n(1.0)), b.fadd(t, n(1.0))), t)
        z = b.fmul(u, u)
        ratio = b.fdiv(to.polynomial(z, ATAN_P), to.polynomial(z, ATAN_Q))
        angle = to.fused(b.fmul(u, z), ratio, u)
        angle = b.select(high, b.fadd(b.fadd(angle, n(MORE / 2)), n(math.pi / 4)), angle)
        angle = b.select(steep, b.fadd(b.fsub(n(math.pi / 2), angle), n(MORE)), angle)
        back = b.icmp("slt", b.bitcast(right, to.integer), to.whole(0))
        angle = b.select(back, b.fadd(b.fsub(n(math.pi), angle), n(2 * MORE)), angle)
        signs = b.and_(b.bitcast(down, to.integer), to.whole(-(2**63)))
        return b.bitcast(b.or_(b.bitcast(angle, to.integer), signs), to.type)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        square = x[0] * x[0] + x[1] * x[1]
        return x[1] / square, -x[0] / square


class _Min(Operation):
    name, numbers, many, commutes = "min", np.minimum, np.minimum, True
    body = "(x < y) ? x : y"

    @staticmethod
    def one(x: float, y: float) -> float:
        return x if x < y else y

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        return to.b.select(to.b.fcmp("olt", *x), *x)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return _greater(x[1], x[0]), _greater(*x)


class _Max(Operation):
    name, numbers, many, commutes = "max", np.maximum, np.maximum, True
    body = "(x > y) ? x : y"

    @staticmethod
    def one(x: float, y: float) -> float:
        return x if x > y else y

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        return to.b.select(to.b.fcmp("ogt", *x), *x)

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return _greater(*x), _greater(x[1], x[0])


def _greater(a: Any, b: Any) -> Any:
    """1 where a is greater than b, 0 where it is less, 1/2 where both are the same."""
    return 0.5 + 0.5 * sign(a - b)


class _Less(Operation):
    """1 where the first one is less than the second, else 0, also of NaN."""

    name, body = "less", "(x < y) ? 1.0 : 0.0"

    @staticmethod
    def one(x: float, y: float) -> float:
        return 1.0 if x < y else 0.0

    @staticmethod
    def many(x: Any, y: Any) -> Any:
        return np.where(x < y, 1.0, 0.0)

    numbers = many

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        mask = to.masks[e.number] = to.b.fcmp("olt", *x)
        return to.b.select(mask, to.number(1.0), to.number(0.0))


class _Select(Operation):
    """The second one where the first one is above zero, else the third."""

    name, body = "select", "(x > 0.0) ? y : z"

    @staticmethod
    def one(x: float, y: float, z: float) -> float:
        return y if x > 0.0 else z

    @staticmethod
    def many(x: Any, y: Any, z: Any) -> Any:
        return np.where(x > 0.0, y, z)

    numbers = many

    def fold(self, x: Any, y: Any, z: Any) -> Any:
        return (y if x.value > 0.0 else z) if x.level == CONSTANT else super().fold(x, y, z)

    def lanes(self, to: Lanes, e: Any, *x: Value) -> Value:
        number = e.args[0].number
        if number not in to.masks:
            to.masks[number] = to.b.fcmp("ogt", x[0], to.number(0.0))
        return to.b.select(to.masks[number], *x[1:])

    def slopes(self, e: Any, *x: Any) -> tuple[Any, ...]:
        return 0.0, select(x[0], 1.0, 0.0), select(x[0], 0.0, 1.0)


_LEAST: Final = 1e-150
add, sub, mul, neg = _Add(), _Sub(), _Mul(), _Neg()
inv, divide = _Inv(), _Divide()
sqrt, sin, cos, exp, tanh = _Sqrt(), _Sin(), _Cos(), _Exp(), _Tanh()
absolute, sign, atan2 = _Abs(), _Sign(), _Atan2()
minimum, maximum, less, select = _Min(), _Max(), _Less(), _Select()
OPERATIONS: Final[Sequence[Operation]] = (
    add, sub, mul, neg, inv, sqrt, sin, cos, exp, tanh, absolute, sign, atan2, minimum, maximum,
    less, select,
)  # fmt: skip


def fused(e: Any, used: Mapping[int, int], known: Container[int]) -> tuple[bool, Any, Any] | None:
    """A product that a sum or a difference is the only one to use: both are one instruction.

    :param used: how often a value is used, by number. ``known``: what is computed elsewhere.
    :returns: whether the product is the first of both, itself, and the other one.
    """
    if e.op is not add and e.op is not sub:
        return None
    for k, product in enumerate(e.args):
        once = product.op is mul and used.get(product.number, 2) == 1
        if once and product.number not in known:
            return k == 0, product, e.args[1 - k]
    return None
