"""The reference of splats: three passes in float64 NumPy, one splat at a time (thesis 4.4.3).

Slow and short; the fast rasterizers are held against it. Each splat is an oriented disc, sampled at pixel centres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.points import NO_NORMAL, pack_rgb, radius_table, unpack_normals, unpack_rgb
from . import ResidentPoints, SplatSettings
from .reference import point_indices
from .splat_geometry import (
    AMBIENT,
    FALLOFF,
    LIGHT,
    MAX_SPLAT_PX,
    SCREEN_RADIUS_PX,
    SHININESS,
    EyeFrame,
    drawn_cells,
    flat_cells,
    splat_columns,
)


@dataclass(frozen=True)
class EyeSplats:
    """(n,) splats in front of the near plane, in eye space: centre, unit normal towards the eye, radius, lit colour.

    index : (n,) int64, the points they come from.  colour : (n, 3) float64, 0…255.
    """

    index: np.ndarray
    center: np.ndarray
    normal: np.ndarray
    radius: np.ndarray
    colour: np.ndarray


Window = tuple[slice, slice]
Fragments = tuple[Window, np.ndarray, np.ndarray, np.ndarray]
"""A window of the image and, for each pixel there, whether it is covered, depth and weight."""


def eye_splats(points: ResidentPoints, camera: Camera, index: np.ndarray, settings: SplatSettings) -> EyeSplats:
    """The splats of the (n,) points that are not in front of the near plane."""
    word, code = splat_columns(points)
    frame = EyeFrame.of(camera)
    block = np.searchsorted(points.block_first_point, index, side="right") - 1
    relative = np.column_stack([c[index] for c in (points.x, points.y, points.z)]).astype(np.float64)
    center = frame.eye_from_blocks(camera, points.block_origin)[block] + relative @ frame.rotation.T
    drawn = np.isfinite(center).all(axis=1) & (center[:, 2] >= camera.near)
    index, center = index[drawn], center[drawn]

    towards_eye = -center / np.linalg.norm(center, axis=1, keepdims=True)
    has_normal = word[index] != NO_NORMAL
    normal = unpack_normals(word[index]).astype(np.float64) @ frame.rotation.T
    normal = np.where(has_normal[:, None], normal, towards_eye)
    normal[_dot(normal, center) > 0] *= -1

    radius = radius_table(points.root_edge)[code[index]] * settings.radius_scale
    radius = np.minimum(radius, MAX_SPLAT_PX * center[:, 2] / camera.focal_px)
    colour = unpack_rgb(points.colour[index])[:, :3].astype(np.float64)
    if settings.lighting:
        colour = np.where(has_normal[:, None], lit(colour, normal, towards_eye), colour)
    return EyeSplats(index, center, normal, radius, colour)


def lit(colour: np.ndarray, normal: np.ndarray, towards_eye: np.ndarray) -> np.ndarray:
    """(n, 3) colours under ambient, diffuse and specular light (thesis Appendix C)."""
    half = towards_eye + LIGHT
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-12)
    diffuse = np.maximum(normal @ LIGHT, 0) + AMBIENT
    specular = np.maximum(_dot(half, normal), 0) ** SHININESS
    return np.clip(colour * diffuse[:, None] + 255 * specular[:, None], 0, 255)


def splat_frame(
    points: ResidentPoints,
    camera: Camera,
    entries: np.ndarray,
    settings: SplatSettings = SplatSettings(),  # noqa: B008 (frozen)
) -> np.ndarray:
    """(height, width) uint64 framebuffer words. Arguments as in ``Rasterizer``; entries are not checked."""
    splats = eye_splats(points, camera, point_indices(entries), settings)
    fragments = [_fragments(splats, i, camera) for i in range(len(splats.index))]
    behind = settings.depth_offset * splats.radius

    # 1. visibility
    front = np.full((camera.height, camera.width), np.inf)
    if settings.features:
        cells = flat_cells(points.features)
        cell = np.searchsorted(cells.first_point, splats.index, side="right")  # the last one that begins before, or 0
        no_quad = splats.index >= np.append(0, cells.first_point + cells.n_points)[cell]
        for i in np.flatnonzero(drawn_cells(cells, entries)):
            _draw_quad(front, camera, cells.quad_center[i], cells.quad_axes[i].astype(np.float64))
        _draw_depths(front, [fragments[i] for i in np.flatnonzero(no_quad)])
        hidden = np.ones(front.shape, bool)
        for (window, covered, depth, _), epsilon in zip(fragments, behind, strict=True):
            hidden[window] &= ~(covered & (depth - epsilon <= front[window]))
        front[hidden] = np.inf  # quads reach a little beyond their splats: where they hide every one, they do not count
        _draw_depths(front, fragments, where=hidden)
    else:
        _draw_depths(front, fragments)

    # 2. colour
    nearest = np.full_like(front, np.inf)
    weight_sum = np.zeros_like(front)
    colour_sum = np.zeros((*front.shape, 3))
    for (window, covered, depth, weight), epsilon, colour in zip(fragments, behind, splats.colour, strict=True):
        accepted = covered & (depth - epsilon <= front[window])
        nearest[window] = np.where(accepted, np.minimum(nearest[window], depth), nearest[window])
        weight_sum[window] += np.where(accepted, weight, 0)
        colour_sum[window] += np.where(accepted, weight, 0)[:, :, None] * colour

    # 3. normalisation
    words = np.full(front.shape, FRAMEBUFFER_EMPTY)
    drawn = weight_sum > 0
    mean = np.floor(colour_sum[drawn] / weight_sum[drawn, None] + 0.5).astype(np.uint8)
    depth_bits = nearest[drawn].astype(np.float32).view(np.uint32).astype(np.uint64)
    words[drawn] = depth_bits << np.uint64(32) | pack_rgb(*mean.T)
    return words


def _fragments(splats: EyeSplats, i: int, camera: Camera) -> Fragments:
    """Of splat i: its window of the image and, for each pixel there, whether it is covered, depth and weight."""
    frame = EyeFrame.of(camera)
    p, normal, radius = splats.center[i], splats.normal[i], splats.radius[i]
    place = frame.focal * p[:2] / p[2] + frame.center
    reach = np.full(2, float(MAX_SPLAT_PX))
    if p[2] > radius:  # how far a ball of this radius reaches on the screen, at most
        ball = frame.focal * radius * (p[2] + np.abs(p[:2])) / (p[2] * (p[2] - radius))
        reach = np.clip(ball, SCREEN_RADIUS_PX, MAX_SPLAT_PX)
    window, ray, pixel = _window(frame, camera, place - reach, place + reach)

    hit, t, q = _plane_hit(ray, p, normal, camera.near)
    disc = np.where(hit, _dot(q - p, q - p) / max(radius * radius, 1e-300), np.inf)
    screen = _dot(pixel - place, pixel - place) / SCREEN_RADIUS_PX**2
    rho_2 = np.minimum(disc, screen)
    return window, rho_2 <= 1, np.where(disc < screen, t, p[2]), np.exp(-FALLOFF * rho_2)


def _draw_depths(front: np.ndarray, fragments: list[Fragments], where: np.ndarray | None = None) -> None:
    """Take the minimum of depths and those of fragments, everywhere or where a mask is set."""
    for window, covered, depth, _ in fragments:
        drawn = covered if where is None else covered & where[window]
        front[window] = np.where(drawn, np.minimum(front[window], depth), front[window])


def _draw_quad(front: np.ndarray, camera: Camera, center: np.ndarray, axes: np.ndarray) -> None:
    """Take the minimum of depths and those of the rectangle with this centre and half axes (world frame)."""
    frame = EyeFrame.of(camera)
    p, (a, b) = frame.eye_from_blocks(camera, center), axes @ frame.rotation.T
    corners = p + np.array([a + b, a - b, b - a, -a - b])
    lower, upper = np.full(2, -np.inf), np.full(2, np.inf)
    if corners[:, 2].min() >= camera.near:
        places = frame.focal * corners[:, :2] / corners[:, 2:] + frame.center
        lower, upper = places.min(axis=0), places.max(axis=0)
    window, ray, _ = _window(frame, camera, lower, upper)
    hit, t, q = _plane_hit(ray, p, np.cross(a, b), camera.near)
    for axis in (a, b):
        hit &= np.abs((q - p) @ axis) <= axis @ axis
    front[window] = np.where(hit, np.minimum(front[window], t), front[window])


def _window(
    frame: EyeFrame, camera: Camera, lower: np.ndarray, upper: np.ndarray
) -> tuple[Window, np.ndarray, np.ndarray]:
    """The pixels whose centres lie between two image positions: window, (h, w, 3) rays, (h, w, 2) centres."""
    size = np.array([camera.width, camera.height])
    begin = np.ceil(np.clip(lower - 0.5, 0, size)).astype(int)
    end = np.maximum(np.floor(np.clip(upper + 0.5, 0, size)).astype(int), begin)
    columns, rows = (np.arange(begin[k], end[k]) + 0.5 for k in range(2))
    pixel = np.stack(np.meshgrid(columns, rows), axis=-1)
    ray = np.concatenate([(pixel - frame.center) / frame.focal, np.ones((*pixel.shape[:2], 1))], axis=-1)
    return (slice(begin[1], end[1]), slice(begin[0], end[0])), ray, pixel


def _plane_hit(
    ray: np.ndarray, p: np.ndarray, normal: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where (…, 3) rays meet the plane through p: whether they do, depth and position (0 where they do not)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (normal @ p) / (ray @ normal)
        hit = np.isfinite(t) & (t >= near)
    t = np.where(hit, t, 0.0)
    return hit, t, t[..., None] * ray


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=-1)
