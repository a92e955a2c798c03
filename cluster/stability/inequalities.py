"""The conditions of the performance model, where the thesis's form of them divides by a latency or turns its sign."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import product

from ...shared.stability.case import case, cases, expect
from ..model.inequalities import Need

_EPS = 2.0**-53


def _exact_s(need: Need) -> Fraction:
    """Time needed in rational arithmetic: the same floats, no rounding. The rate must not be 0."""
    count, latency, data, rate = (Fraction(x) for x in (need.count, need.latency_s, need.data, need.rate_per_s))
    return count * latency + data / rate


def _wrong_verdicts(needs: Iterator[tuple[Need, float]]) -> int:
    """Needs whose verdict at a frame rate differs from the exact one, though they differ from 1/F by more than 8 ε."""
    wrong = 0
    for need, frames_per_s in needs:
        exact, budget = _exact_s(need), 1 / Fraction(frames_per_s)
        decided = abs(exact - budget) > 8 * Fraction(_EPS) * max(exact, budget)
        wrong += decided and (need.seconds <= 1 / frames_per_s) != (exact <= budget)
    return wrong


@case("model/F·l from 1e-6 to 1e6", bound=0.0, unit="verdicts")
def latency_against_frame() -> float:
    """Verdicts of k·l + D/B ≤ 1/F that are wrong in rational arithmetic, F·k·l from 1e-6 to 1e6 and 1 among them."""
    grid = product((1.0, 3.0, 1000.0), (10.0**e for e in range(-9, 3)), (0.0, 1.0, 1e6, 1e12), (1.0, 15.0, 1e4))
    needs = [(Need(k, latency, data, 1e9), rate) for k, latency, data, rate in grid]
    expect(any(n.count * n.latency_s * rate >= 1 for n, rate in needs), "some F·l ≥ 1")
    return _wrong_verdicts(iter(needs))


@cases("model/rates apart by", bounds={1e6: 4 * _EPS, 1e12: 4 * _EPS, 1e18: 4 * _EPS}, unit="of the time")
def rates_apart(ratio: float) -> float:
    """Largest relative error of the time needed, latency and bandwidth terms apart by the ratio either way."""
    needs = [Need(3.0, 0.1 * r, 0.7, 1 / (0.3 / r)) for r in (ratio, 1.0, 1 / ratio)]
    needs += [Need(7.0, 1e-6, data, rate) for data in (1.1, 1.1 * ratio) for rate in (0.9, 0.9 * ratio)]
    return max(float(abs(Fraction(need.seconds) - _exact_s(need)) / _exact_s(need)) for need in needs)


@case("model/zero bandwidth and zero data", bound=0.0, unit="answers")
def nothing() -> float:
    """Answers that are wrong: data at rate 0 allows 0 frames/s, no data any number, and no answer is NaN or raises."""
    stuck, idle = Need(0.0, 0.0, 5.0, 0.0), Need(0.0, 0.0, 0.0, 0.0)
    only_latency = Need(2.0, 0.25, 0.0, 0.0)
    answers = [
        (stuck.seconds, float("inf")),
        (stuck.largest_frames_per_s, 0.0),
        (stuck.largest_data(15.0), 0.0),
        (idle.seconds, 0.0),
        (idle.largest_frames_per_s, float("inf")),
        (idle.largest_data(15.0), 0.0),
        (only_latency.largest_frames_per_s, 2.0),
        (only_latency.largest_data(15.0), 0.0),
    ]
    return sum(found != expected for found, expected in answers)


@case("model/largest and smallest floats", bound=0.0, unit="answers")
def extremes() -> float:
    """Times and limits that are negative or NaN, for every combination of 0, 5e-324, 1e-300, 1, 1e300 and 1.8e308."""
    values = (0.0, 5e-324, 1e-300, 1.0, 1e300, 1.7976931348623157e308)
    bad = 0
    for four in product(values, repeat=4):
        need = Need(*four)
        answers = (need.seconds, need.largest_frames_per_s, need.largest_data(5e-324), need.largest_data(1e300))
        bad += sum(not answer >= 0 for answer in answers)
    return bad
