"""Complex numbers for the Python functions from which loops are compiled: the derivative of f is Im f(x + ih)/h.

W. Squire and G. Trapp, Using complex variables to estimate derivatives of real functions, SIAM Rev. 40 (1998) 110-112.
No difference is taken, so h may be so small that the error is rounding alone. Comparisons are those of real parts, so
that a function takes the branch of its real argument.
"""

from __future__ import annotations

import cmath
import importlib
import math
import pkgutil
import sys
from collections.abc import Callable
from typing import Any

from pfem_petsc.mechanics import materials

__all__ = ["SIZE", "Complex", "ComplexMath", "derivative", "patch", "real"]

SIZE = 1e-60
"""Of the imaginary part of arguments; its square is still a normal number."""


def _value(number: Any) -> complex:
    return number.z if isinstance(number, Complex) else complex(number)


class Complex:
    """A complex number that is ordered by its real part; it cannot become a float by mistake."""

    __slots__ = ("z",)
    __array_ufunc__ = None  # NumPy's numbers leave operations to this class
    __hash__ = None

    def __init__(self, real: float, imaginary: float = 0.0) -> None:
        self.z = complex(real, imaginary)

    @classmethod
    def of(cls, z: complex) -> Complex:
        return cls(z.real, z.imag)

    def __add__(self, other: Any) -> Complex:
        return Complex.of(self.z + _value(other))

    def __sub__(self, other: Any) -> Complex:
        return Complex.of(self.z - _value(other))

    def __rsub__(self, other: Any) -> Complex:
        return Complex.of(_value(other) - self.z)

    def __mul__(self, other: Any) -> Complex:
        return Complex.of(self.z * _value(other))

    def __truediv__(self, other: Any) -> Complex:
        return Complex.of(self.z / _value(other))

    def __rtruediv__(self, other: Any) -> Complex:
        return Complex.of(_value(other) / self.z)

    def __pow__(self, other: Any) -> Complex:
        return Complex.of(self.z ** _value(other))

    def __rpow__(self, other: Any) -> Complex:
        return Complex.of(_value(other) ** self.z)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Complex:
        return Complex.of(-self.z)

    def __abs__(self) -> Complex:
        return -self if self.z.real < 0.0 else self

    def __bool__(self) -> bool:
        return self.z.real != 0.0

    def __lt__(self, other: Any) -> bool:
        return self.z.real < _value(other).real

    def __le__(self, other: Any) -> bool:
        return self.z.real <= _value(other).real

    def __gt__(self, other: Any) -> bool:
        return self.z.real > _value(other).real

    def __ge__(self, other: Any) -> bool:
        return self.z.real >= _value(other).real

    def __eq__(self, other: object) -> bool:
        return self.z.real == _value(other).real

    def __repr__(self) -> str:
        return f"Complex({self.z})"


class ComplexMath:
    """The module ``math`` for numbers of both kinds; a function that is missing here raises TypeError."""

    def __getattr__(self, name: str) -> Any:
        real = getattr(math, name)
        if not callable(real):
            return real
        extended = _EXTENDED.get(name) or getattr(cmath, name, None)

        def function(*arguments: Any) -> Any:
            if not any(isinstance(argument, Complex) for argument in arguments):
                return real(*arguments)
            if extended is None:
                raise TypeError(f"math.{name} has no complex form here")
            return Complex.of(extended(*map(_value, arguments)))

        return function


_EXTENDED: dict[str, Callable[..., complex]] = {
    "expm1": lambda z: complex(
        math.expm1(z.real) * math.cos(z.imag) - 2.0 * math.sin(0.5 * z.imag) ** 2, math.exp(z.real) * math.sin(z.imag)
    ),
    "log1p": lambda z: complex(0.5 * math.log1p(z.real * (2.0 + z.real) + z.imag**2), math.atan2(z.imag, 1.0 + z.real)),
}


def patch(monkeypatch: Any) -> None:
    """Give the modules of bars and laws functions of complex numbers."""
    for law in pkgutil.iter_modules(materials.__path__):
        importlib.import_module(f"{materials.__name__}.{law.name}")
    for name, module in list(sys.modules.items()):
        if name.startswith("pfem_petsc.mechanics") and getattr(module, "math", None) is math:
            monkeypatch.setattr(module, "math", ComplexMath())


def derivative(value: Any) -> float:
    """Return the derivative of a value with respect to an argument that is Complex(x, SIZE)."""
    return _value(value).imag / SIZE


def real(value: Any) -> float:
    """Return the real part."""
    return _value(value).real
