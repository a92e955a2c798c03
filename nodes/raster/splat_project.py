"""Compiled kernel of the ``cpu`` splat rasterizer, first part: points → what each pixel needs to know of a splat.

Per pixel, a splat's plane is met at the depth w / (1 + k) with k affine in the offset (x, y) from the projected centre,
and the squared distance from the centre, in radii, is a quadratic form of that offset over (1 + k)². So ten numbers
a splat replace the intersection of a ray with a disc. Offsets from the centre are small numbers, so float32 serves.

``BATCH`` points at a time go through loops without branches, which the compiler vectorises; those that reach into the
image are then written out one behind the other.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ...shared.points import NO_NORMAL
from .atomic import fetch_add
from .splat_geometry import AMBIENT, LIGHT, MAX_SPLAT_PX, SCREEN_RADIUS_PX, SHININESS

SPLAT = np.dtype(
    [(name, "<f4") for name in ("u", "v", "w", "behind", "kx", "ky", "qxx", "qxy", "qyy", "red", "green", "blue")]
    + [("nearest", "<f4"), ("is_disc", "<u4"), ("visible", "<u4"), ("unused", "<u4")]
)
"""A splat on the screen, one cache line.

u, v : image position of the centre, pixels.  w : its depth.
behind : how much deeper than the nearest surface its fragments may be, world units.
kx, ky : 1 + k = w / depth of the plane; k = kx · x + ky · y at x, y pixels from the centre.
qxx, qxy, qyy : squared distance in radii is (qxx x² + 2 qxy x y + qyy y²) / (1 + k)².
red, green, blue : lit colour, 0…255.
nearest : no fragment is nearer than this.
is_disc : 0 if the disc is smaller than the screen term everywhere.  visible : whether it is in the visibility pass.
"""

BOUNDS = np.dtype([("left", "<u2"), ("top", "<u2"), ("right", "<u2"), ("bottom", "<u2")])
"""Pixels that a splat or quad may cover: columns left … right − 1, rows top … bottom − 1, inside the image."""

BATCH = 256
_SLACK_PX = np.float32(0.1)  # what float32 may lose of a bound, at any width of the image
_FLOAT_MAX = np.float32(np.finfo(np.float32).max)
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_MAX, _SCREEN = np.float32(MAX_SPLAT_PX), np.float32(SCREEN_RADIUS_PX)
_LX, _LY, _LZ = (np.float32(v) for v in LIGHT)
_AMBIENT, _WHITE = np.float32(AMBIENT), np.float32(255)
_OCT, _NO_NORMAL = np.float32(1 / 32767), np.uint32(NO_NORMAL)
_SQUARINGS = SHININESS.bit_length() - 1

# where the columns of a batch begin in its scratch array
_N_COLUMNS = 23
_PX, _PY, _PW, _NX, _NY, _NW, _RADIUS, _RED, _GREEN, _BLUE, _U, _V = (np.uintp(k * BATCH) for k in range(12))
_KX, _KY, _QXX, _QXY, _QYY = (np.uintp(k * BATCH) for k in range(12, 17))
_LEFT, _TOP, _RIGHT, _BOTTOM, _NEAREST, _IS_DISC = (np.uintp(k * BATCH) for k in range(17, 23))


@njit(nogil=True, cache=True)
def project(points, flat, pieces, chunks, rows, rotation, pinhole, view, radii, behind, lighting, out, totals, counter):
    """Project chunks of pieces until none is left.

    points : x, y, z (n,) float32; colour (n,) uint32; normal (n,) uint32; radius (n,) uint8.
    flat : (n,) uint8, 1 where a quad stands for the point in the visibility pass, or empty: nowhere.
    pieces : (p,) PIECE.  chunks : (c + 1, 2) int64, first piece and first place in ``out`` of each chunk, and the ends.
    rows : (s, 3, 4) float32, eye from block, by segment.  rotation : (3, 3) float32, eye from world directions.
    pinhole : focal x, y, centre x, y in pixels, largest radius at depth 1; float32.
    view : near, width, height as float32.  radii : (256,) float32, world units, by code.
    behind : ε in radii.  lighting : whether normals light.
    out : (m,) SPLAT and (m,) BOUNDS.  totals : (c, 2) int64: splats written from the chunk's first place on, and how
        many of them are visible in the first pass.
    counter : (1,) int64, shared by the threads of a frame, 0 at its start.
    """
    x, y, z, colour, normal, radius = points
    splats, bounds = out
    scratch = np.empty(_N_COLUMNS * BATCH, np.float32)
    words, normals, visible = np.empty(BATCH, np.uint32), np.empty(BATCH, np.uint32), np.empty(BATCH, np.uint8)
    chunk = fetch_add(counter, 1)
    while chunk < len(chunks) - 1:
        place, n, n_visible = chunks[chunk, 1], 0, 0
        for k in range(chunks[chunk, 0], chunks[chunk + 1, 0]):
            s, stride, left = np.uintp(pieces[k].segment), np.int64(pieces[k].stride), np.int64(pieces[k].count)
            first = pieces[k].first
            while left > 0:
                m = min(left, BATCH - n)
                _gather(x, y, z, first, stride, m, rows, s, scratch, n)
                for i in range(m):
                    j, to = np.uintp(first + i * stride), np.uintp(n + i)
                    words[to], normals[to], visible[to] = colour[j], normal[j], 1
                    scratch[_RADIUS + to] = radii[radius[j]]
                if len(flat):
                    for i in range(m):
                        visible[np.uintp(n + i)] = 1 - flat[np.uintp(first + i * stride)]
                n, left, first = n + m, left - m, first + m * stride
                if n == BATCH:
                    _shape(scratch, normals, words, n, rotation, pinhole, view, lighting)
                    written, seen = _write(scratch, visible, n, behind, splats, bounds, place)
                    place, n_visible, n = place + written, n_visible + seen, 0
        _shape(scratch, normals, words, n, rotation, pinhole, view, lighting)
        written, seen = _write(scratch, visible, n, behind, splats, bounds, place)
        totals[chunk, 0] = place + written - chunks[chunk, 1]
        totals[chunk, 1] = n_visible + seen
        chunk = fetch_add(counter, 1)


@njit(nogil=True, cache=True)
def _gather(x, y, z, first, stride, m, rows, s, scratch, n):
    """Eye-space positions of the ``m`` points first, first + stride, … into a batch, from place ``n`` on."""
    r00, r01, r02, r03 = rows[s, 0, 0], rows[s, 0, 1], rows[s, 0, 2], rows[s, 0, 3]
    r10, r11, r12, r13 = rows[s, 1, 0], rows[s, 1, 1], rows[s, 1, 2], rows[s, 1, 3]
    r20, r21, r22, r23 = rows[s, 2, 0], rows[s, 2, 1], rows[s, 2, 2], rows[s, 2, 3]
    for i in range(m):
        j, to = np.uintp(first + i * stride), np.uintp(n + i)
        scratch[_PX + to] = r00 * x[j] + r01 * y[j] + r02 * z[j] + r03
        scratch[_PY + to] = r10 * x[j] + r11 * y[j] + r12 * z[j] + r13
        scratch[_PW + to] = r20 * x[j] + r21 * y[j] + r22 * z[j] + r23


@njit(nogil=True, cache=True)
def _shape(scratch, normals, words, n, rotation, pinhole, view, lighting):
    """Normals, colours and extents of the first ``n`` points of a batch."""
    _orient(scratch, normals, n, rotation)
    if lighting:
        _light(scratch, normals, words, n)
    else:
        for k in range(n):
            i = np.uintp(k)
            scratch[_RED + i], scratch[_GREEN + i], scratch[_BLUE + i] = _channels(words[i])
    _extend(scratch, n, pinhole, view)


@njit(nogil=True, cache=True, error_model="numpy")
def _orient(scratch, normals, n, rotation):
    """Normals in eye space, turned towards the eye; where there is none, straight towards it."""
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    for k in range(n):
        i = np.uintp(k)
        ox = np.float32(np.int16(normals[i] & np.uint32(0xFFFF))) * _OCT
        oy = np.float32(np.int16(normals[i] >> np.uint32(16))) * _OCT
        oz = _ONE - abs(ox) - abs(oy)
        fx = (_ONE - abs(oy)) * (_ONE if ox >= _ZERO else -_ONE)
        fy = (_ONE - abs(ox)) * (_ONE if oy >= _ZERO else -_ONE)
        ox, oy = fx if oz < _ZERO else ox, fy if oz < _ZERO else oy
        px, py, pw = scratch[_PX + i], scratch[_PY + i], scratch[_PW + i]
        none = normals[i] == _NO_NORMAL
        nx = -px if none else r00 * ox + r01 * oy + r02 * oz
        ny = -py if none else r10 * ox + r11 * oy + r12 * oz
        nw = -pw if none else r20 * ox + r21 * oy + r22 * oz
        scale = _ONE / np.sqrt(nx * nx + ny * ny + nw * nw)
        scale = -scale if nx * px + ny * py + nw * pw > _ZERO else scale
        scratch[_NX + i], scratch[_NY + i], scratch[_NW + i] = nx * scale, ny * scale, nw * scale


@njit(nogil=True, cache=True)
def _channels(word):
    """Red, green, blue of a colour word, 0…255."""
    red = np.float32(np.int32(word & np.uint32(255)))
    green = np.float32(np.int32(word >> np.uint32(8) & np.uint32(255)))
    return red, green, np.float32(np.int32(word >> np.uint32(16) & np.uint32(255)))


@njit(nogil=True, cache=True, error_model="numpy")
def _light(scratch, normals, words, n):
    """Ambient, diffuse and specular light on splats that have a normal (thesis Appendix C)."""
    for k in range(n):
        i = np.uintp(k)
        px, py, pw = scratch[_PX + i], scratch[_PY + i], scratch[_PW + i]
        nx, ny, nw = scratch[_NX + i], scratch[_NY + i], scratch[_NW + i]
        inverse = _ONE / np.sqrt(px * px + py * py + pw * pw)
        hx, hy, hw = _LX - px * inverse, _LY - py * inverse, _LZ - pw * inverse
        length_2 = hx * hx + hy * hy + hw * hw
        shine = (hx * nx + hy * ny + hw * nw) / np.sqrt(length_2)
        shine = shine if shine > _ZERO else _ZERO  # also for NaN: light from straight ahead
        for _ in range(_SQUARINGS):
            shine *= shine
        diffuse = _LX * nx + _LY * ny + _LZ * nw
        diffuse = (diffuse if diffuse > _ZERO else _ZERO) + _AMBIENT
        none = normals[i] == _NO_NORMAL
        diffuse, shine = _ONE if none else diffuse, _ZERO if none else shine * _WHITE
        red, green, blue = _channels(words[i])
        scratch[_RED + i] = min(red * diffuse + shine, _WHITE)
        scratch[_GREEN + i] = min(green * diffuse + shine, _WHITE)
        scratch[_BLUE + i] = min(blue * diffuse + shine, _WHITE)


@njit(nogil=True, cache=True, error_model="numpy")
def _extend(scratch, n, pinhole, view):
    """Where splats are on the screen, how their planes lie, which pixels they may cover (none: right = left)."""
    fx, fy, cx, cy, clamp = pinhole
    near, width, height = view
    for k in range(n):
        i = np.uintp(k)
        px, py, pw = scratch[_PX + i], scratch[_PY + i], scratch[_PW + i]
        nx, ny, nw = scratch[_NX + i], scratch[_NY + i], scratch[_NW + i]
        r = min(scratch[_RADIUS + i], clamp * pw)
        x, y = px / pw, py / pw
        u, v = fx * x + cx, fy * y + cy

        facing = nx * x + ny * y + nw  # n·p / w, ≤ 0
        kx, ky = nx / (fx * facing), ny / (fy * facing)
        scale = (pw / r) * (pw / r)
        across = x * x + y * y + _ONE
        qxx = scale * (_ONE / (fx * fx) - _TWO * kx * x / fx + kx * kx * across)
        qxy = scale * (kx * ky * across - kx * y / fy - ky * x / fx)
        qyy = scale * (_ONE / (fy * fy) - _TWO * ky * y / fy + ky * ky * across)

        # The columns at which a plane through the eye touches the disc are the roots of a quadratic; rows likewise.
        rr = (r / pw) * (r / pw)
        a = _ONE - rr * (_ONE - nw * nw)
        root_x = rr * (_ONE + x * x - (nx - x * nw) * (nx - x * nw) - rr * ny * ny)
        root_y = rr * (_ONE + y * y - (ny - y * nw) * (ny - y * nw) - rr * nx * nx)
        middle_x, half_x = fx * ((x + rr * nx * nw) / a) + cx, fx * np.sqrt(max(root_x, _ZERO)) / a
        middle_y, half_y = fy * ((y + rr * ny * nw) / a) + cy, fy * np.sqrt(max(root_y, _ZERO)) / a
        whole = a <= np.float32(1e-4)  # it reaches past the eye: no bound but the largest
        left = u - _MAX if whole else max(min(u - _SCREEN, middle_x - half_x) - _SLACK_PX, u - _MAX)
        right = u + _MAX if whole else min(max(u + _SCREEN, middle_x + half_x) + _SLACK_PX, u + _MAX)
        top = v - _MAX if whole else max(min(v - _SCREEN, middle_y - half_y) - _SLACK_PX, v - _MAX)
        bottom = v + _MAX if whole else min(max(v + _SCREEN, middle_y + half_y) + _SLACK_PX, v + _MAX)
        inside = (pw >= near) & (pw <= _FLOAT_MAX)
        inside &= (left < width) & (right > _ZERO) & (top < height) & (bottom > _ZERO)

        # the disc lies inside the screen term if the least eigenvalue of q is ≥ (1 + k)² wherever that term reaches
        steepest = _ONE + _SCREEN * (abs(kx) + abs(ky))
        least = _HALF * (qxx + qyy) - np.sqrt(_HALF * _HALF * (qxx - qyy) * (qxx - qyy) + qxy * qxy)

        scratch[_RADIUS + i], scratch[_U + i], scratch[_V + i] = r, u, v
        scratch[_KX + i], scratch[_KY + i] = kx, ky
        scratch[_QXX + i], scratch[_QXY + i], scratch[_QYY + i] = qxx, qxy, qyy
        scratch[_LEFT + i] = _floor(max(left + _HALF, _ZERO)) if inside else _ZERO
        scratch[_RIGHT + i] = _floor(min(right + _HALF, width)) if inside else _ZERO
        scratch[_TOP + i] = _floor(max(top + _HALF, _ZERO)) if inside else _ZERO
        scratch[_BOTTOM + i] = _floor(min(bottom + _HALF, height)) if inside else _ZERO
        scratch[_NEAREST + i] = pw - r
        scratch[_IS_DISC + i] = _ZERO if least * _SCREEN * _SCREEN >= steepest * steepest else _ONE


@njit(nogil=True, cache=True)
def _floor(x):
    """floor(x) of x ≥ 0, as float32; unlike np.floor it vectorises."""
    return np.float32(np.int32(x))


@njit(nogil=True, cache=True)
def _write(scratch, visible, n, behind, splats, bounds, place):
    """Write those of the first ``n`` splats that reach into the image: how many, how many of them visible."""
    begin, n_visible = place, 0
    for k in range(n):
        i = np.uintp(k)
        left, right = np.int32(scratch[_LEFT + i]), np.int32(scratch[_RIGHT + i])
        top, bottom = np.int32(scratch[_TOP + i]), np.int32(scratch[_BOTTOM + i])
        if left < right and top < bottom:
            b, s = bounds[place], splats[place]
            b.left, b.right, b.top, b.bottom = left, right, top, bottom
            s.u, s.v, s.w = scratch[_U + i], scratch[_V + i], scratch[_PW + i]
            s.kx, s.ky = scratch[_KX + i], scratch[_KY + i]
            s.qxx, s.qxy, s.qyy = scratch[_QXX + i], scratch[_QXY + i], scratch[_QYY + i]
            s.red, s.green, s.blue = scratch[_RED + i], scratch[_GREEN + i], scratch[_BLUE + i]
            s.behind = behind * scratch[_RADIUS + i]
            s.nearest = scratch[_NEAREST + i]
            s.is_disc, s.visible = np.uint32(scratch[_IS_DISC + i]), visible[i]
            n_visible += visible[i]
            place += 1
    return place - begin, n_visible
