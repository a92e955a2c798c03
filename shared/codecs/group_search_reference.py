"""Construction of linear groups in one partition, written to be read: the paper's ``find_grouping``.

Source: Dinerstein, Egbert, Flann, "Linear Grouping", section 3. Readings taken where it leaves something open:

- *Within ε.* A point is where it will be drawn, at the nearest of 256 steps of the segment from V1 (0) towards V2
  (255/256), and that place must be within ε of it. So ε bounds the error with the coding of parameters in it, and the
  paper's bounding box, "required" for clipping, always holds: what is on the segment and within ε is within the box.
- *Average group size.* What is used up so far holds |P| grouped points for |D| that define lines. The points still free
  are predicted to go the same way, which makes n·|P| / (|P| + |D|) at the end; a candidate is rejected if that is less
  than the best so far.
- *Cannot be best.* A solution that is as good as the best so far is none better, so ≤ stands for the paper's <.
- *Ties* of the best-first order go by the indices of the two points.

Whole numbers only: nothing is rounded, so nothing depends on who computes it.
"""

from __future__ import annotations

from itertools import combinations

Point = tuple[int, int, int]
Group = tuple[int, int, dict[int, int]]
"""Index of V1, index of V2 > V1, and {index of a grouped point: its parameter in 1/256}."""


def parameter(first: Point, second: Point, point: Point, epsilon: float) -> int | None:
    """Where on the segment a point is, in 1/256; None unless that place is within ε of it."""
    line = [b - a for a, b in zip(first, second, strict=True)]
    away = [q - a for a, q in zip(first, point, strict=True)]
    along, length = (sum(x * y for x, y in zip(line, other, strict=True)) for other in (away, line))
    t = min(max((512 * along + length) // (2 * length), 0), 255) if length else 0
    error = sum((256 * x - t * y) ** 2 for x, y in zip(away, line, strict=True))
    return t if error <= (256 * epsilon) ** 2 else None


def find_grouping(points: list[Point], epsilon: float, most_ends: int = 1) -> list[Group]:
    """The best grouping among the first ``most_ends`` ends of branches; ε in the unit of the points."""
    near = {
        (v1, v2): {
            q: t
            for q in range(len(points))
            if q not in (v1, v2) and (t := parameter(points[v1], points[v2], points[q], epsilon)) is not None
        }
        for v1, v2 in combinations(range(len(points)), 2)
    }
    pairs = sorted(near, key=lambda pair: -len(near[pair]))
    best: list[Group] = []
    best_grouped = ends = 0

    def search(groups: list[Group], defining: set[int], grouped: set[int], free: set[int]) -> None:
        nonlocal best, best_grouped, ends
        constructed = False
        for v1, v2 in pairs:
            if ends == most_ends:
                return
            candidates = {q: t for q, t in near[v1, v2].items() if q in free}
            if grouped & {v1, v2} or not candidates:  # no nonproductive groups
                continue
            d, p = defining | {v1, v2}, grouped | candidates.keys()
            f = free - d - p
            if len(f) + len(p) <= best_grouped:  # cannot be the best solution
                continue
            if len(points) * len(p) < best_grouped * (len(p) + len(d)):  # average group size
                continue
            constructed = True
            search([*groups, (v1, v2, candidates)], d, p, f)
        if not constructed:
            ends += 1
            if len(grouped) > best_grouped:
                best, best_grouped = groups, len(grouped)

    search([], set(), set(), set(range(len(points))))
    return best
