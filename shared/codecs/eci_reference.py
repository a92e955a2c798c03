"""Extended cell identification (ECI) of one component, written to be read: the paper's sections 2.2, 3.2 and 4.2.

Points are sorted in layers of neighbours. A *seed* is a point with points of the next layer *connected* to it, up to 26
around it. The stream goes from seed to seed, layer by layer, and says of each connected point where it lies from its
seed, and of those that are seeds how many points are connected to them and how many of these are seeds in turn.

Source: Mallón, Bóo, Amor, Bruguera, "Algorithms and Hardware for Data Compression in Point Rendering Applications".
Readings taken where it can be read in two ways:

- *Label of the first point.* Figure 4 prints 000 for the point (0, 0, 0), which has no seed to be relative to: its
  coordinates, in as many bits as the cube needs (the figure: one bit an axis; a cube of 32³: five).
- *Number_Seeds* takes "log2 ψ" bits "in [1, 5]" for 0 … ψ: the number of bits of ψ, ⌊log2 ψ⌋ + 1, is what fits both.
- *Order of seeds.* "Seed points with higher number of neighbors in the next layer are processed first", and the decoder
  takes seeds in the order of the stream: so seeds are chosen among the points connected to one seed, the one with most
  neighbours not yet taken first, and each takes them. Equal ones, and points that are not seeds, stay in the order in
  which they were given: the paper does not say, and no order of the offsets fits its figure.
- *Connectivity* is five bits for 1 … 26; 0 stands only at a first point without neighbours.
- Figure 3b prints 10,10,11 at both 11 and 17: it is 11's; 17 is 10,11,11.
- *Several components* and the end of a cube are not in the paper: ``eci`` says what stands between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product

from ..errors import CodecError

Point = tuple[int, int, int]
OFFSET_BITS = {-1: (0,), 0: (1, 0), 1: (1, 1)}
CONNECTIVITY_BITS = 5
MOST_CONNECTED = 26


@dataclass
class Node:
    """A point and the points of the next layer that it is the seed of, those that are seeds themselves first."""

    point: Point
    connected: list[Node] = field(default_factory=list)

    @property
    def n_seeds(self) -> int:
        """Number of connected points that are seeds."""
        return sum(bool(node.connected) for node in self.connected)


def take_component(points: dict[Point, int]) -> Node:
    """The layers that start from the first of the points: a dictionary to the place of each in the order given.

    Takes all points of the component out of ``points``.
    """
    first = min(points, key=points.__getitem__)
    del points[first]
    root = Node(first)
    root.connected = [Node(point) for point in _neighbours(first, points)]
    for node in root.connected:
        del points[node.point]
    seeds = [root]
    while seeds:
        for seed in seeds:
            seed.connected = _choose_seeds(seed.connected, points)
        seeds = [node for seed in seeds for node in seed.connected if node.connected]
    return root


def _choose_seeds(nodes: list[Node], points: dict[Point, int]) -> list[Node]:
    """The nodes, seeds first; each seed takes its neighbours out of ``points``."""
    chosen, rest = [], list(nodes)
    while rest:
        best = max(rest, key=lambda node: len(_neighbours(node.point, points)))
        taken = _neighbours(best.point, points)
        if not taken:
            break
        for point in taken:
            del points[point]
        best.connected = [Node(point) for point in taken]
        chosen.append(best)
        rest.remove(best)
    return chosen + rest


def _neighbours(point: Point, points: dict[Point, int]) -> list[Point]:
    around = ((point[0] + x, point[1] + y, point[2] + z) for x, y, z in product((-1, 0, 1), repeat=3))
    return sorted((other for other in around if other in points and other != point), key=points.__getitem__)


def seeds(root: Node) -> Iterator[Node]:
    """The first point and then all seeds, in the order of the stream."""
    queue = [root]
    for seed in queue:  # grows while it is walked: layer by layer
        yield seed
        queue += seed.connected[: seed.n_seeds]


def coded_order(root: Node) -> list[Point]:
    """All points in the order of the stream."""
    return [root.point] + [node.point for seed in seeds(root) for node in seed.connected]


def encode_component(root: Node, root_bits: int) -> list[int]:
    """The bits of a component; ``root_bits`` an axis for the coordinates of its first point."""
    bits = [bit for value in root.point for bit in _number(value, root_bits)] + _seed_fields(root)
    for seed in seeds(root):
        for node in seed.connected:
            for a, b in zip(node.point, seed.point, strict=True):
                bits += OFFSET_BITS[a - b]
            if node.connected:
                bits += _seed_fields(node)
    return bits


def _seed_fields(node: Node) -> list[int]:
    connectivity = len(node.connected)
    return _number(connectivity, CONNECTIVITY_BITS) + _number(node.n_seeds, connectivity.bit_length())


def _number(value: int, width: int) -> list[int]:
    return [value >> i & 1 for i in reversed(range(width))]


class BitReader:
    """Bits one after the other. Raises CodecError behind the last one."""

    def __init__(self, bits: Sequence[int]):
        self._bits = bits
        self.at = 0

    def number(self, width: int) -> int:
        """The next ``width`` bits, the highest first."""
        if self.at + width > len(self._bits):
            raise CodecError(f"coded points: found {len(self._bits)} bits, expected more")
        value = 0
        for bit in self._bits[self.at : self.at + width]:
            value = value << 1 | bit
        self.at += width
        return value

    def offset(self) -> int:
        """−1, 0 or 1 in its one or two bits."""
        return self.number(1) if self.number(1) else -1


def decode_component(bits: BitReader, root_bits: int, edge: int, taken: set[Point]) -> list[Point]:
    """The points of a component in the order of the stream, added to ``taken``.

    Raises CodecError for points outside of the cube or taken already, and for fields that no encoder writes.
    """
    points: list[Point] = []

    def add(point: Point) -> Point:
        if point in taken or not all(0 <= value < edge for value in point):
            raise CodecError(f"coded points: found {point}, expected a new point below {edge}")
        taken.add(point)
        points.append(point)
        return point

    def seed_fields() -> tuple[int, int]:
        connectivity = bits.number(CONNECTIVITY_BITS)
        n_seeds = bits.number(connectivity.bit_length())
        if connectivity > MOST_CONNECTED or n_seeds > connectivity:
            raise CodecError(f"coded points: found connectivity {connectivity} with {n_seeds} seeds")
        return connectivity, n_seeds

    root = add((bits.number(root_bits), bits.number(root_bits), bits.number(root_bits)))
    queue = [(root, *seed_fields())]
    for seed, connectivity, n_seeds in queue:  # grows while it is walked: layer by layer
        for i in range(connectivity):
            point = add((seed[0] + bits.offset(), seed[1] + bits.offset(), seed[2] + bits.offset()))
            if i < n_seeds:
                fields = seed_fields()
                if not fields[0]:
                    raise CodecError("coded points: found a seed with no point connected")
                queue.append((point, *fields))
    return points
