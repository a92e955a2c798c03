"""Colour: which colour a stored point has, and what a framebuffer looks like as an image.

Everything ends in colour words (``points.pack_rgb``). Scalars go through a matplotlib colour map of 256 entries,
imported when one is used.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from .camera_path import up_vector
from .errors import ConfigError
from .messages import FRAMEBUFFER_EMPTY
from .points import NO_NORMAL, pack_rgb, unpack_normals
from .store import Scene

MODES = ("auto", "rgb", "intensity", "elevation", "classification", "level", "normal")
_COLOUR_MAPPED = ("intensity", "elevation", "level")
_CHUNK = 1 << 18
_SAMPLE = 1 << 14
_PERCENTILES = (2.0, 98.0)

CLASS_COLOURS = {
    0: "#9e9e9e",  # created, never classified
    1: "#bdbdbd",  # unclassified
    2: "#a67c52",  # ground
    3: "#c5e1a5",  # low vegetation
    4: "#7cb342",  # medium vegetation
    5: "#33691e",  # high vegetation
    6: "#d84f3f",  # building
    7: "#ff00ff",  # low point (noise)
    8: "#8d99ae",  # model key point / reserved
    9: "#3f8fd2",  # water
    10: "#6d4c41",  # rail
    11: "#616161",  # road surface
    12: "#8e9aaf",  # overlap / reserved
    13: "#fdd835",  # wire, guard
    14: "#ffb300",  # wire, conductor
    15: "#5e35b1",  # transmission tower
    16: "#fb8c00",  # wire-structure connector
    17: "#90a4ae",  # bridge deck
    18: "#ff4dff",  # high noise
}
"""Colours of the ASPRS classes (LAS 1.4 R15, table 17)."""
OTHER_CLASS = "#00bcd4"  # 19–255: reserved and user-defined
_CLASS_CODES = [str(code) for code in range(256)]


@dataclass(frozen=True)
class Colouring:
    """How the points of a scene are coloured; made and checked by ``choose``.

    mode : one of ``MODES`` but ``auto``, or ``constant``.
    attribute : the attribute it reads, or None.
    colormap : of the scalar modes.  value_range : values at its two ends; None: found from the points.
    word : the colour of mode ``constant``.
    class_colours : colours of class codes, in place of ``CLASS_COLOURS``.
    """

    mode: str
    attribute: str | None
    colormap: str
    value_range: tuple[float, float] | None
    word: np.uint32
    class_colours: Mapping[int, str] = field(default_factory=dict)

    @classmethod
    def choose(
        cls,
        scene: Scene,
        mode: str,
        colormap: str = "viridis",
        value_range: tuple[float, float] | None = None,
        class_colours: Mapping[str, str] = MappingProxyType({}),
    ) -> Colouring:
        """The colouring that a configuration asks for.

        ``auto`` takes the first that tells something: rgb, then normal, then intensity, then elevation; an attribute
        with one value everywhere tells nothing.

        class_colours : by code as text, ``"0"`` … ``"255"``.

        Raises ConfigError for an unknown mode or colour map, an attribute the scene lacks, an empty range, or what is
        no class or colour.
        """
        word = np.uint32(0)
        if mode == "auto":
            telling = (name for name in ("rgb", "normal", "intensity") if _varies(scene, name))
            mode = next(telling, "elevation")
        elif mode.startswith("#"):
            word, mode = parse_colour(mode, "render.colour").view("<u4")[0], "constant"
        elif mode not in MODES:
            raise ConfigError(f"render.colour = {mode!r}, expected one of {', '.join(MODES)} or #rrggbb")
        attribute = mode if mode in ("rgb", "intensity", "classification", "normal") else None
        if attribute is not None and attribute not in scene.info.attributes:
            found = ", ".join(scene.info.attributes) or "no attribute"
            raise ConfigError(f"render.colour = {mode!r}: the scene has {found}; auto takes what there is")
        if value_range is not None and not (all(map(math.isfinite, value_range)) and value_range[0] != value_range[1]):
            raise ConfigError(f"render.colour_range = {list(value_range)}, expected two different numbers")
        if mode in _COLOUR_MAPPED:
            colormap_words(colormap)
        return cls(mode, attribute, colormap, value_range, word, _class_colours(class_colours))

    def settled(self, scene: Scene) -> Colouring:
        """The same with its range of values found, so that other copies of the scene's points get the same colours."""
        if not self.range_is_open:
            return self
        return self.with_range_of(self.range_sample(scene, 0, scene.info.n_stored))

    @property
    def range_is_open(self) -> bool:
        """Whether the range of values is to be found from the points."""
        return self.mode in _COLOUR_MAPPED and self.value_range is None

    def range_sample(self, scene: Scene, first: int, n: int) -> np.ndarray:
        """(k,) float64: of the sample of n values that decides on the range, those of the points in ``scene``.

        scene : all n points, or a share that begins at point ``first``. Samples of all shares, end to end, are that of
        the whole scene.
        """
        index = _sample(n) - first
        index = index[(index >= 0) & (index < scene.info.n_stored)]
        return np.asarray(_scalars(scene, self.mode)(index), np.float64)

    def with_range_of(self, sample: np.ndarray) -> Colouring:
        """The same with the range of values that a sample shows."""
        return replace(self, value_range=_robust_range(sample))


def colour_words(scene: Scene, colouring: Colouring) -> np.ndarray:
    """(n_stored,) uint32 colour words of a scene's points.

    Cost: one read of the attribute; memory 4 bytes a point (none for rgb, whose stored column is mapped, and for one
    colour, which is repeated with stride 0).
    """
    n = scene.info.n_stored
    if not n:  # a scene without points has no columns either
        return np.empty(0, "<u4")
    match colouring.mode:
        case "rgb":
            return scene.attribute("rgb")
        case "constant":
            return np.broadcast_to(colouring.word, n)
    return _by_chunk(n, word_reader(scene, colouring))


def word_reader(scene: Scene, colouring: Colouring) -> Callable[[slice], np.ndarray]:
    """``colour_words`` of a slice, with both ends, of a scene's points: (k,) uint32, in no more memory than that takes.

    Cost: of what it reads of the scene, besides columns of points, once; then one read of the slice at each call.
    """
    match colouring.mode:
        case "rgb":
            words = scene.column("attr_rgb")
            return lambda part: words[part]
        case "constant":
            return lambda part: np.broadcast_to(colouring.word, part.stop - part.start)
        case "classification":
            palette = _class_palette({**CLASS_COLOURS, **colouring.class_colours})
            codes = scene.column("attr_classification")
            return lambda part: palette[codes[part]]
        case "normal":
            normals, table = scene.column("attr_normal"), _shade_table(up_vector(scene.info))
            bare = shade(np.zeros((1, 3), np.float32), up_vector(scene.info))
            return lambda part: _shade_words(normals[part], table, bare)
        case mode:
            values = _scalars(scene, mode)
            sample = values(_sample(scene.info.n_stored)) if colouring.range_is_open else np.empty(0)
            low, high = colouring.value_range or _robust_range(np.asarray(sample, np.float64))
            table = colormap_words(colouring.colormap)
            return lambda part: map_scalars(values(part), low, high, table)


def map_scalars(values: np.ndarray, low: float, high: float, table: np.ndarray) -> np.ndarray:
    """(n,) uint32 words of (n,) values: ``table`` (256,) from low to high, clamped; not a number: its first colour.

    Where low equals high, the table's middle colour.
    """
    half_span = high / 2 - low / 2  # halves, so that no range overflows
    if half_span == 0:
        return np.full(len(values), table[len(table) // 2])
    inside = np.clip(np.nan_to_num(values.astype(np.float64), nan=low), min(low, high), max(low, high))
    return table[np.rint((inside / 2 - low / 2) / half_span * (len(table) - 1)).astype(np.uint8)]


def shade(normals: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(n,) uint32 words of a clay model lit from above, from (n, 3) float32 unit normals.

    A soft key light stands 45° up at one side, a dim cool one opposite. Light does not depend on the normal's sign
    (two-sided: scans do not always know it) except for a third of the key. A point without a normal is mid-grey.
    """
    side = np.roll(np.abs(up), 1)
    key = (side + 0.6 * np.cross(up, side) + 1.2 * up).astype(np.float32)
    key /= np.linalg.norm(key)
    fill = np.cross(key, side.astype(np.float32))
    fill /= np.linalg.norm(fill)
    toward_key = normals @ key
    lit = 0.18 + 0.47 * np.abs(toward_key) + 0.25 * np.maximum(toward_key, 0.0)
    cool = 0.10 * np.abs(normals @ fill)
    lit[~normals.any(axis=1)] = 0.5
    channels = [lit * warm + cool * tint for warm, tint in ((1.0, 0.8), (0.955, 0.9), (0.89, 1.2))]
    return pack_rgb(*(np.rint(np.minimum(c, 1.0) * 255).astype(np.uint8) for c in channels))


def _shade_table(up: np.ndarray) -> np.ndarray:
    """(65 536,) uint32 shades by the top bytes of both components of a normal word, within three steps of 255."""
    index = np.arange(1 << 16, dtype="<u4")
    return shade(unpack_normals((index & 0xFF) << 8 | index >> 8 << 24 | 0x0080_0080), up)


def _shade_words(words: np.ndarray, table: np.ndarray, bare: np.ndarray) -> np.ndarray:
    """(n,) uint32 colour words of normal words, from a table of shades and the shade of a point without a normal."""
    return np.where(words == NO_NORMAL, bare, table[words >> 8 & 0xFF | words >> 24 << 8])


def parse_colour(text: str, key: str) -> np.ndarray:
    """(4,) uint8 RGBA of ``#rrggbb``, ``transparent`` or a colour name. Raises ConfigError naming ``key``."""
    from PIL import ImageColor

    if text == "transparent":
        return np.zeros(4, np.uint8)
    try:
        return np.array((*ImageColor.getrgb(text)[:3], 255), np.uint8)
    except ValueError:
        raise ConfigError(f"{key} = {text!r}, expected #rrggbb, transparent or a colour name") from None


def frame_to_rgba(words: np.ndarray, background: np.ndarray) -> np.ndarray:
    """(h, w, 4) uint8 image of (h, w) uint64 framebuffer words; (4,) uint8 ``background`` where no point fell.

    Cost: one pass, 12 bytes a pixel.
    """
    image = words.astype("<u4")  # keeps the low half, the colour
    image[words == FRAMEBUFFER_EMPTY] = background.view("<u4")[0]
    return image.view(np.uint8).reshape(*words.shape, 4)


# --- what the modes read ----------------------------------------------------------------------------------------

_Part = slice | np.ndarray
"""Which stored points: a slice with both ends, or ascending indices."""


def _scalars(scene: Scene, mode: str) -> Callable[[_Part], np.ndarray]:
    """The values of a scalar mode, part by part."""
    if mode == "intensity":
        intensity = scene.column("attr_intensity")
        return lambda part: intensity[part]
    if mode == "elevation":
        up = up_vector(scene.info)
        axis = int(np.abs(up).argmax())
        sign = up[axis]
        column = scene.positions()[axis] if scene.info.coded else scene.column("xyz"[axis])
        first, origin = scene.blocks()
        return lambda part: sign * (column[part] + origin[_owner(first, part), axis])
    octree = scene.octree()
    owners = np.arange(len(octree)) if octree.point_order == "layered" else np.flatnonzero(octree.is_leaf)
    owners = owners[np.argsort(octree.first_point[owners])]
    first = octree.first_point[owners]
    return lambda part: octree.level[owners[_owner(first, part)]]


def _owner(first: np.ndarray, part: _Part) -> np.ndarray:
    """(n,) index of the range that holds each point, of ranges that start at ascending ``first``."""
    if isinstance(part, np.ndarray):
        return np.searchsorted(first, part, side="right") - 1
    a, b = np.searchsorted(first, [part.start, part.stop - 1], side="right")
    bounds = np.concatenate([[part.start], first[a:b], [part.stop]])
    return np.repeat(np.arange(a - 1, b), np.diff(bounds))


def _by_chunk(n: int, words: Callable[[slice], np.ndarray]) -> np.ndarray:
    """(n,) uint32 words, made a bounded number at a time."""
    out = np.empty(n, "<u4")
    for start in range(0, n, _CHUNK):
        part = slice(start, min(start + _CHUNK, n))
        out[part] = words(part)
    return out


def _sample(n: int) -> np.ndarray:
    """Ascending indices of at most ``_SAMPLE`` of n points, always the same."""
    return np.arange(n) if n <= _SAMPLE else np.unique(np.random.default_rng(0).integers(0, n, _SAMPLE))


def _varies(scene: Scene, name: str) -> bool:
    """Whether the scene has the attribute with more than one value."""
    if name not in scene.info.attributes:
        return False
    values = scene.column(f"attr_{name}")[_sample(scene.info.n_stored)]
    return bool((values != values[0]).any())


def _robust_range(sample: np.ndarray) -> tuple[float, float]:
    """The 2nd and 98th percentile of the finite values of a sample; (0, 0) where there are none."""
    finite = sample[np.isfinite(sample)]
    if not len(finite):
        return 0.0, 0.0
    low, high = np.percentile(finite, _PERCENTILES)
    return float(low), float(high)


def _class_colours(table: Mapping[str, str]) -> dict[int, str]:
    """Colours by class code. Raises ConfigError naming the key of what is no class or no colour."""
    found = {}
    for code, colour in table.items():
        key = f"render.class_colours.{code}"
        if code not in _CLASS_CODES:
            raise ConfigError(f"{key}: found class {code!r}, expected a code of 0…255")
        if parse_colour(colour, key)[3] == 0:
            raise ConfigError(
                f"{key} = {colour!r}, expected #rrggbb or a colour name; filter.classes leaves out points"
            )
        found[int(code)] = colour
    return found


def _class_palette(colours: Mapping[int, str]) -> np.ndarray:
    """(256,) uint32 colour word of each class code."""
    rgba = np.array([parse_colour(colours.get(code, OTHER_CLASS), "class") for code in range(256)])
    return rgba.view("<u4").ravel()


def colormap_words(name: str, key: str = "render.colormap") -> np.ndarray:
    """(256,) uint32 words of a matplotlib colour map. Raises ConfigError naming ``key`` and near names for another."""
    from matplotlib import colormaps

    if name not in colormaps:
        near = ", ".join(difflib.get_close_matches(name, list(colormaps), n=3, cutoff=0.0))
        raise ConfigError(f"{key} = {name!r}, expected a matplotlib colour map such as {near}")
    return np.ascontiguousarray(colormaps[name](np.linspace(0.0, 1.0, 256), bytes=True)).view("<u4").ravel()
