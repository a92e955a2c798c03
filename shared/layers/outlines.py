"""Outlines → fans: outlines, concave, with holes, crossing themselves, as pieces that wedges around a vertex fill.

The paper's wedges, from a centre to each edge, fill star-shaped outlines only. So outlines are triangulated once, when
a layer is built, and neighbouring triangles joined to *fans*: closed loops that are star-shaped as seen from their
first vertex, the *apex*. A fan of k edges makes k − 2 triangles (a centre would make k), and no new point but where
edges cross. A convex outline is one fan.

Inside is what a ray leaves across an odd number of edges (even-odd). So the direction of rings does not matter, rings
inside rings are holes, an edge that is there twice (the cut of a keyhole, the wall between two faces) vanishes, and an
outline that crosses itself is drawn as its lobes.

Coordinates are integers, so that which side a point lies on is exact:

1. edges are cut where they meet until they only share ends; a crossing is rounded to integers, so this is repeated;
2. edges that are there an even number of times vanish;
3. a sweep along x triangulates what is between the rest: Hertel, Mehlhorn, "Fast triangulation of the plane with
   respect to simple polygons" (1985);
4. neighbours are joined while the piece is convex, then while one of its vertices sees all of it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

COORDINATE_BITS = 24
"""Coordinates are within ±2**24: products of differences fit int64 with room, and float32 holds them exactly."""

_SHIFT = COORDINATE_BITS + 2
_HALF = 1 << COORDINATE_BITS
_MASK = (1 << _SHIFT) - 1
_ROUNDS = 64
_STAR = 64  # edges of the largest piece of which it is tried whether a vertex sees all of it
DONE, TOO_MANY_CROSSINGS, TOO_MANY_ABREAST, NOT_SETTLED = 0, 1, 2, 3
MOST_PAIRS = 1 << 33
"""Of edges with a common x that are looked at for where they meet: some ten seconds."""


def fans(rings: list[np.ndarray], most_pairs: int = MOST_PAIRS) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The fans of (k, 2) int64 rings within ±2**24, closed by themselves, whether they repeat their first point or not.

    Returns (m, 2) int64 points; (m, 2) int64 apex of each; (m,) bool: the edge from this point to the next is one of
    the outline; and DONE, or why there is nothing: TOO_MANY_CROSSINGS, TOO_MANY_ABREAST, NOT_SETTLED. A fan is a run
    of points with one apex, the first and last of which are the apex itself. Fans go counterclockwise. Nothing
    inside: m = 0.

    Cost: O((n + crossings) · edges abreast) for n edges, in a few passes.
    """
    rings = [ring for ring in rings if len(ring) > 2] or [np.zeros((1, 2), np.int64)]
    keys = [(ring[:, 0] + _HALF << _SHIFT) | ring[:, 1] + _HALF for ring in rings]
    start = np.concatenate(keys)
    end = np.concatenate([np.roll(k, -1) for k in keys])
    low, high, status = _planar(start, end, most_pairs)
    if status != DONE or not len(low):
        empty = np.empty((0, 2), np.int64)
        return empty, empty, np.empty(0, bool), status
    points = np.unique(np.concatenate((low, high)))
    x, y = points >> _SHIFT, points & _MASK
    corners = _triangles(x, y, np.searchsorted(points, low), np.searchsorted(points, high))
    point, apex, side = _joined(x, y, corners)
    vertices = np.column_stack([x - _HALF, y - _HALF])
    return vertices[point], vertices[apex], side, DONE


@njit(nogil=True, cache=True)
def _turn(ax, ay, bx, by, cx, cy):
    """Twice the area of the triangle a, b, c: above 0 if it goes counterclockwise."""
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


@njit(nogil=True, cache=True)
def _odd(start, end):
    """Edges that are there an odd number of times, from their lower to their higher key, sorted by these."""
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.argsort(high, kind="mergesort")
    order = order[np.argsort(low[order], kind="mergesort")]
    low, high = low[order], high[order]
    keep = np.zeros(len(low), np.bool_)
    first = 0
    for i in range(len(low)):
        if i + 1 == len(low) or low[i + 1] != low[i] or high[i + 1] != high[i]:
            keep[i] = (i + 1 - first) % 2 == 1 and low[i] != high[i]
            first = i + 1
    return low[keep], high[keep]


@njit(nogil=True, cache=True)
def _planar(start, end, most_pairs):
    """Edges (as ``_odd``) with the same inside that meet at their ends only."""
    low, high = _odd(start, end)
    most = 8 * len(start) + 1024
    for _ in range(_ROUNDS):
        if _pairs(low >> _SHIFT, high >> _SHIFT) > most_pairs:
            return low, high, TOO_MANY_ABREAST
        edge, at = _meetings(low, high, most)
        if len(edge) > most:
            return low, high, TOO_MANY_CROSSINGS
        if not len(edge):
            return low, high, DONE
        low, high = _cut(low, high, edge, at)
    return low, high, NOT_SETTLED


@njit(nogil=True, cache=True)
def _pairs(low_x, high_x):
    """How many pairs of edges have a common x. Edges sorted by ``low_x``."""
    return (np.searchsorted(low_x, high_x, side="right") - np.arange(len(low_x)) - 1).sum()


@njit(nogil=True, cache=True)
def _meetings(low, high, most):
    """Which edge meets another inside of itself, and the keys where; stops above ``most``. Edges sorted by ``low``."""
    edge, at = np.empty(64, np.int64), np.empty(64, np.int64)
    n = 0
    ax, ay, bx, by = low >> _SHIFT, low & _MASK, high >> _SHIFT, high & _MASK
    for i in range(len(low)):
        bottom, top = min(ay[i], by[i]), max(ay[i], by[i])
        for j in range(i + 1, len(low)):
            if ax[j] > bx[i]:
                break
            if min(ay[j], by[j]) > top or max(ay[j], by[j]) < bottom:
                continue
            if n + 4 > len(edge):
                edge, at = np.concatenate((edge, edge)), np.concatenate((at, at))
            first = _turn(ax[i], ay[i], bx[i], by[i], ax[j], ay[j])
            second = _turn(ax[i], ay[i], bx[i], by[i], bx[j], by[j])
            third = _turn(ax[j], ay[j], bx[j], by[j], ax[i], ay[i])
            fourth = _turn(ax[j], ay[j], bx[j], by[j], bx[i], by[i])
            # points of one line stand along it in the order of their keys
            if first == 0 and low[i] < low[j] < high[i]:
                edge[n], at[n], n = i, low[j], n + 1
            if second == 0 and low[i] < high[j] < high[i]:
                edge[n], at[n], n = i, high[j], n + 1
            if third == 0 and low[j] < low[i] < high[j]:
                edge[n], at[n], n = j, low[i], n + 1
            if fourth == 0 and low[j] < high[i] < high[j]:
                edge[n], at[n], n = j, high[i], n + 1
            meets_line = first != 0 and second != 0 and (first > 0) != (second > 0)
            if meets_line and third != 0 and fourth != 0 and (third > 0) != (fourth > 0):
                t = third / (third - fourth)
                x = ax[i] + np.int64(np.rint(t * (bx[i] - ax[i])))
                y = ay[i] + np.int64(np.rint(t * (by[i] - ay[i])))
                key = (x << _SHIFT) | y
                if key != low[i] and key != high[i]:
                    edge[n], at[n], n = i, key, n + 1
                if key != low[j] and key != high[j]:
                    edge[n], at[n], n = j, key, n + 1
            if n > most:
                return edge[:n], at[:n]
    return edge[:n], at[:n]


@njit(nogil=True, cache=True)
def _cut(low, high, edge, at):
    """Edges cut at points, as ``_odd``."""
    along = np.empty(len(edge), np.int64)
    for i in range(len(edge)):
        a, b = low[edge[i]], high[edge[i]]
        dx, dy = (b >> _SHIFT) - (a >> _SHIFT), (b & _MASK) - (a & _MASK)
        along[i] = dx * ((at[i] >> _SHIFT) - (a >> _SHIFT)) + dy * ((at[i] & _MASK) - (a & _MASK))
    order = np.argsort(along, kind="mergesort")
    order = order[np.argsort(edge[order], kind="mergesort")]
    start, end = np.empty(len(low) + len(edge), np.int64), np.empty(len(low) + len(edge), np.int64)
    n = k = 0
    for i in range(len(low)):
        here = low[i]
        while k < len(order) and edge[order[k]] == i:
            start[n], end[n] = here, at[order[k]]
            here = at[order[k]]
            n, k = n + 1, k + 1
        start[n], end[n] = here, high[i]
        n += 1
    return _odd(start, end)


@njit(nogil=True, cache=True)
def _triangles(x, y, low, high):
    """(t, 3) corners, counterclockwise, of the triangles between edges that meet at ends only.

    x, y : of vertices, sorted by x, then y.  low, high : ends of edges, sorted by ``low``.

    The sweep knows the edges that cross its line, from below to above; every other gap between them is inside. For
    each such gap, named by the edge below it, it keeps a chain: the vertices of what is not yet triangulated, from the
    lower edge's to the upper edge's. A chain never turns right, so its rightmost vertex sees whatever comes next.
    """
    n, m = len(x), len(low)
    corners = np.empty((2 * (n + m), 3), np.int64)
    n_corners = 0
    size = 4 * (n + m)
    vertex, before, after = np.empty(size, np.int64), np.full(size, -1), np.full(size, -1)
    n_nodes = 0
    lower, upper, right = np.full(m, -1), np.full(m, -1), np.full(m, -1)  # nodes of the chain above an edge
    active = np.empty(m, np.int64)
    n_active = 0
    out = np.empty(m, np.int64)
    next_edge = 0
    for v in range(n):
        k = 0
        while next_edge < m and low[next_edge] == v:  # edges that begin here, from below to above
            place = k
            while place > 0:
                other = high[out[place - 1]]
                if _turn(x[v], y[v], x[high[next_edge]], y[high[next_edge]], x[other], y[other]) < 0:
                    break
                out[place] = out[place - 1]
                place -= 1
            out[place] = next_edge
            k, next_edge = k + 1, next_edge + 1
        first, last = 0, n_active  # the first active edge that is not below the vertex
        while first < last:
            middle = (first + last) // 2
            e = active[middle]
            if _turn(x[low[e]], y[low[e]], x[high[e]], y[high[e]], x[v], y[v]) > 0:
                first = middle + 1
            else:
                last = middle
        ending = 0
        while first + ending < n_active and high[active[first + ending]] == v:
            ending += 1
        beneath, above = first % 2 == 1, (first + ending) % 2 == 1  # is it inside there?
        opened = -1  # the chain above the vertex, as long as its lower edge is not known: its lowest node
        opened_upper = -1
        if ending == 0 and beneath:  # in a gap: its chain is parted at its rightmost vertex, which sees this one
            e = active[first - 1]
            r = right[e]
            twin = n_nodes
            n_nodes += 1
            vertex[twin], after[twin] = vertex[r], after[r]
            if after[r] != -1:
                before[after[r]] = twin
            opened_upper = twin if upper[e] == r else upper[e]
            after[r] = -1
            n_corners, n_nodes = _above(corners, n_corners, vertex, before, after, n_nodes, x, y, r, v)
            upper[e] = right[e] = n_nodes - 1
            n_corners, n_nodes = _below(corners, n_corners, vertex, before, after, n_nodes, x, y, twin, v)
            opened = n_nodes - 1
        elif ending:
            for i in range(first, first + ending - 1):
                if i % 2 == 0:  # a gap that ends here
                    e = active[i]
                    n_corners, n_nodes = _above(corners, n_corners, vertex, before, after, n_nodes, x, y, upper[e], v)
            if beneath:
                e = active[first - 1]
                n_corners, n_nodes = _above(corners, n_corners, vertex, before, after, n_nodes, x, y, upper[e], v)
                upper[e] = right[e] = n_nodes - 1
            if above:
                e = active[first + ending - 1]
                opened_upper = upper[e]
                n_corners, n_nodes = _below(corners, n_corners, vertex, before, after, n_nodes, x, y, lower[e], v)
                opened = n_nodes - 1
        if k:
            for i in range(k - 1):
                if (first + i + 1) % 2 == 1:  # a gap that begins here
                    vertex[n_nodes] = v
                    lower[out[i]] = upper[out[i]] = right[out[i]] = n_nodes
                    n_nodes += 1
            if opened != -1:
                e = out[k - 1]
                lower[e], upper[e], right[e] = opened, opened_upper, opened
        elif beneath and opened != -1:  # two gaps become one
            e = active[first - 1]
            after[upper[e]] = after[opened]
            before[after[opened]] = upper[e]
            upper[e] = opened_upper
        if k > ending:
            for i in range(n_active - 1, first + ending - 1, -1):
                active[i + k - ending] = active[i]
        elif k < ending:
            for i in range(first + ending, n_active):
                active[i + k - ending] = active[i]
        for i in range(k):
            active[first + i] = out[i]
        n_active += k - ending
    return corners[:n_corners]


@njit(nogil=True, cache=True)
def _above(corners, n_corners, vertex, before, after, n_nodes, x, y, node, v):
    """Put a vertex behind the upper end of a chain, as the last node made; triangles for what is cut off."""
    while before[node] != -1:
        a, b = vertex[before[node]], vertex[node]
        if _turn(x[a], y[a], x[b], y[b], x[v], y[v]) >= 0:
            break
        corners[n_corners] = a, v, b
        n_corners += 1
        node = before[node]
    vertex[n_nodes], before[n_nodes], after[n_nodes] = v, node, -1
    after[node] = n_nodes
    return n_corners, n_nodes + 1


@njit(nogil=True, cache=True)
def _below(corners, n_corners, vertex, before, after, n_nodes, x, y, node, v):
    """The same before the lower end."""
    while after[node] != -1:
        a, b = vertex[node], vertex[after[node]]
        if _turn(x[v], y[v], x[a], y[a], x[b], y[b]) >= 0:
            break
        corners[n_corners] = v, b, a
        n_corners += 1
        node = after[node]
    vertex[n_nodes], after[n_nodes], before[n_nodes] = v, node, -1
    before[node] = n_nodes
    return n_corners, n_nodes + 1


@njit(nogil=True, cache=True)
def _joined(x, y, corners):
    """Loops of vertices around an apex each, from (t, 3) triangles; and which edges have one side only.

    Half-edge 3 t + i goes from corner i of triangle t to the next. Pieces are loops of half-edges, at first the
    triangles; those on both sides of an edge become one where that is convex, then where a vertex sees all of it.
    No three neighbours of a loop are in line as its apex sees them: all vertices are corners of triangles, so that
    nothing shines through where these meet.
    """
    n_half = 3 * len(corners)
    origin = corners.ravel()
    onward, back = np.empty(n_half, np.int64), np.empty(n_half, np.int64)
    for h in range(n_half):
        onward[h], back[h] = h - h % 3 + (h + 1) % 3, h - h % 3 + (h + 2) % 3
    twin = _twins(origin, origin[onward], len(x))
    seer = np.arange(n_half)  # at the root of a piece: the half-edge whose origin is its apex
    root = np.arange(n_half) // 3 * 3
    size = np.full(n_half, 3)
    convex = np.ones(n_half, np.bool_)
    inner = np.zeros(n_half, np.bool_)
    loop = np.empty(2 * _STAR, np.int64)
    for stars in (False, True, True):
        for h in range(n_half):
            t = twin[h]
            if t < h or inner[h]:  # also without twin; each edge once
                continue
            one, other = _root(root, h), _root(root, t)
            if one == other:
                continue
            a, b = origin[h], origin[t]
            c, d = origin[back[h]], origin[onward[onward[t]]]
            e, f = origin[back[t]], origin[onward[onward[h]]]
            both = convex[one] and convex[other]
            both = (
                both and _turn(x[c], y[c], x[a], y[a], x[d], y[d]) > 0 and _turn(x[e], y[e], x[b], y[b], x[f], y[f]) > 0
            )
            apex = onward[h]
            if not both:
                if not stars or size[one] + size[other] - 2 > _STAR:
                    continue
                apex = _star(x, y, origin, onward, h, t, loop)
                if apex == -1:
                    continue
            onward[back[h]], back[onward[t]] = onward[t], back[h]
            onward[back[t]], back[onward[h]] = onward[h], back[t]
            inner[h] = inner[t] = True
            root[other] = one
            size[one] += size[other] - 2
            convex[one], seer[one] = both, apex
    point, apexes = np.empty(2 * n_half, np.int64), np.empty(2 * n_half, np.int64)
    side = np.zeros(2 * n_half, np.bool_)
    made = 0
    for piece in range(0, n_half, 3):
        if root[piece] != piece:
            continue
        h = seer[piece]
        apexes[made : made + size[piece] + 1] = origin[h]
        for _ in range(size[piece]):
            point[made], side[made] = origin[h], twin[h] == -1
            made, h = made + 1, onward[h]
        point[made] = origin[h]
        made += 1
    return point[:made], apexes[:made], side[:made]


@njit(nogil=True, cache=True)
def _twins(origin, target, n):
    """The half-edge that goes the other way, −1 where there is none."""
    key = origin * n + target
    order = np.argsort(key)
    found = np.minimum(np.searchsorted(key[order], target * n + origin), len(key) - 1)
    twin = order[found]
    for h in range(len(key)):
        if origin[twin[h]] != target[h] or target[twin[h]] != origin[h]:
            twin[h] = -1
    return twin


@njit(nogil=True, cache=True)
def _root(root, h):
    """The half-edge that stands for the piece of a half-edge."""
    at = h - h % 3
    while root[at] != at:
        root[at] = root[root[at]]
        at = root[at]
    return at


@njit(nogil=True, cache=True)
def _star(x, y, origin, onward, h, t, loop):
    """A half-edge from whose origin the loops on both sides of an edge can all be seen, −1 where there is none."""
    n = 0
    for first, last in ((onward[h], h), (onward[t], t)):
        at = first
        while at != last:
            loop[n] = at
            n, at = n + 1, onward[at]
    for i in range(n):
        p = origin[loop[i]]
        sees = True
        for j in range(1, n - 1):
            a, b = origin[loop[(i + j) % n]], origin[loop[(i + j + 1) % n]]
            if _turn(x[p], y[p], x[a], y[a], x[b], y[b]) <= 0:
                sees = False
                break
        if sees:
            return loop[i]
    return -1
