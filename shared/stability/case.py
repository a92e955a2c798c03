"""A stability case: one number that the program must keep below a bound, and where the number comes from.

Each case runs the program's own code on an extreme input, compares it with a reference (float64, integers, or 50
digits) and returns the largest difference. Nothing is sampled by chance: seeds are fixed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

PASSED, FAILED, OUT_OF_REACH = "passed", "failed", "out of reach"


class OutOfReach(Exception):
    """Raised by a case that cannot be measured here; the message is the reason."""


class NothingMeasured(Exception):
    """Raised by a case whose own premise does not hold, so that its number would mean nothing."""


@dataclass(frozen=True)
class Case:
    """One comparison.

    name : ``subject/what`` and, in a family, the parameter.  what : what is compared with what, for people.
    bound : the value must be at most this; not a number never is.  unit : of value and bound.
    measure : the value.
    """

    name: str
    what: str
    bound: float
    unit: str
    measure: Callable[[], float]


@dataclass(frozen=True)
class Outcome:
    """What became of a case. value : None where there is none, and ``reason`` says why."""

    case: Case
    verdict: str
    value: float | None
    reason: str
    seconds: float


def case(name: str, *, bound: float, unit: str) -> Callable[[Callable[[], float]], Case]:
    """Make a case of a function without arguments; its docstring says what is compared with what."""
    return lambda function: Case(name, _text(function), bound, unit, function)


def cases(name: str, *, bounds: Mapping[Any, float], unit: str) -> Callable[[Callable[[Any], float]], tuple[Case, ...]]:
    """Make a family of cases of a function of one parameter. bounds : parameter → bound."""

    def decorate(function: Callable[[Any], float]) -> tuple[Case, ...]:
        return tuple(
            Case(f"{name} {_label(parameter)}", _text(function), bound, unit, partial(function, parameter))
            for parameter, bound in bounds.items()
        )

    return decorate


def _text(function: Callable[..., float]) -> str:
    """The docstring as one line."""
    return " ".join((function.__doc__ or "").split())


def _label(parameter: Any) -> str:
    return f"{parameter:g}" if isinstance(parameter, int | float) else str(parameter)


def out_of_reach(name: str, what: str, reason: str) -> Case:
    """A case that is named, and not measured, for a stated reason."""

    def measure() -> float:
        raise OutOfReach(reason)

    return Case(name, what, 0.0, "", measure)


def collect(modules: Iterable[ModuleType]) -> list[Case]:
    """The cases that modules define, in their order."""
    found: list[Case] = []
    for module in modules:
        for value in vars(module).values():
            if isinstance(value, Case):
                found.append(value)
            elif isinstance(value, tuple):
                found += [item for item in value if isinstance(item, Case)]
    return found


def run(case: Case) -> Outcome:
    """Measure a case. An exception is a failure whose reason is the exception: an extreme input must raise none."""
    start = time.perf_counter()
    value, reason = None, ""
    try:
        found = float(case.measure())
        verdict = PASSED if found <= case.bound else FAILED
        if math.isfinite(found):
            value = found
        else:
            verdict, reason = FAILED, f"found {found}, expected a finite number"
    except OutOfReach as limit:
        verdict, reason = OUT_OF_REACH, str(limit)
    except Exception as error:
        verdict, reason = FAILED, f"{type(error).__name__}: {error}"
    return Outcome(case, verdict, value, reason, time.perf_counter() - start)


def expect(holds: Any, premise: str) -> None:
    """Raise NothingMeasured unless the premise of a case holds."""
    if not holds:
        raise NothingMeasured(f"premise does not hold: {premise}")


def fifty_digits() -> Any:
    """A context of mpmath with 50 decimal digits. Raises OutOfReach where mpmath is missing."""
    try:
        import mpmath
    except ImportError:
        raise OutOfReach("mpmath is missing: install splatpipe[stability]") from None
    context = mpmath.mp.clone()
    context.dps = 50
    return context
