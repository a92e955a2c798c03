"""Linear groups: construction against the paper's recursion, ε, bytes, maps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.codecs import group_search_reference as reference
from splatpipe.shared.codecs.group_search import STEPS, group_partitions, partitions
from splatpipe.shared.codecs.linear_groups import LinearGroupCodec, read, write
from splatpipe.shared.codecs.occupancy_kernels import morton_keys
from splatpipe.shared.errors import CodecError


@st.composite
def clouds(draw, most=60):
    """Points of any density, some on a line, some many times."""
    bits = draw(st.integers(1, 21))
    last = (1 << bits) - 1
    near = draw(st.integers(0, last))
    coordinate = st.one_of(st.integers(0, last), st.integers(near, min(near + 3, last)), st.sampled_from([0, last]))
    points = draw(st.lists(st.tuples(coordinate, coordinate, coordinate), max_size=most // 2))
    points += [(min(i * near // 7, last), near, last) for i in range(draw(st.integers(0, most // 4)))]
    points += draw(st.lists(st.sampled_from(points), max_size=most // 4)) if points else []
    epsilon = draw(
        st.one_of(st.just(0.0), st.floats(0, 4), st.floats(0, 1).map(lambda part: part * last), st.just(1e300))
    )
    return bits, np.array(points, np.int64).reshape(-1, 3), epsilon


def surface(n=3000, bits=12, seed=3):
    """(n, 3) grid points of a wavy sheet."""
    u, v = np.random.default_rng(seed).uniform(0, 1, (2, n))
    z = 0.5 + 0.1 * np.sin(7 * u) * np.cos(5 * v)
    return np.floor(np.column_stack([u, v, z]) * (1 << bits)).astype(np.int64)


def sorted_by_key(points, bits):
    keys = morton_keys(points.astype(np.uint32), bits)
    order = np.argsort(keys, kind="stable")
    return points[order], keys[order]


@given(cloud=clouds(most=16), ends=st.integers(1, 4))
@settings(deadline=None, max_examples=150)
def test_the_same_groups_as_the_papers_recursion(cloud, ends):
    bits, points, epsilon = cloud
    epsilon = min(epsilon, 2.0 ** (bits + 1))
    limit = np.array([int((STEPS * epsilon) ** 2)])
    group, parameter, found, _ = group_partitions(
        points, np.array([0, len(points)]), np.array([int(epsilon)]), limit, ends
    )
    expected = reference.find_grouping([tuple(p) for p in points.tolist()], epsilon, ends)
    assert [
        (*pair.tolist(), {int(q): int(parameter[q]) for q in np.flatnonzero(group == g)})
        for g, pair in enumerate(found)
    ] == expected


def test_a_longer_search_finds_what_the_first_solution_misses():
    found = [LinearGroupCodec(40, part_points=64, most_ends=ends).group(surface(1000), 12)[0] for ends in (1, 30)]
    assert 300 < len(found[0].parameter) < len(found[1].parameter)


def leaves(points, bits, most, level=0):
    """Sizes of the leaves of an octree over points, in Morton order."""
    if len(points) <= most:
        return [len(points)] if len(points) else []
    if level == bits:
        return [len(points[i : i + most]) for i in range(0, len(points), most)]
    child = points >> (bits - 1 - level) & 1
    octant = child[:, 0] + 2 * child[:, 1] + 4 * child[:, 2]
    return [size for o in range(8) for size in leaves(points[octant == o], bits, most, level + 1)]


@given(cloud=clouds(), most=st.integers(2, 30))
@settings(deadline=None, max_examples=80)
def test_partitions_are_leaves_of_an_octree_taken_together(cloud, most):
    bits, points, _ = cloud
    expected = []
    for size in leaves(points, bits, most):
        if expected and expected[-1] + size <= most:
            expected[-1] += size
        else:
            expected.append(size)
    _, keys = sorted_by_key(points, bits)
    assert np.diff(partitions(keys, bits, most)).tolist() == expected


@given(cloud=clouds(), most=st.integers(2, 40), detail=st.one_of(st.none(), st.floats(0, 1)))
@settings(deadline=None, max_examples=100)
def test_every_point_is_within_epsilon_and_decodes_the_same(cloud, most, detail):
    bits, points, epsilon = cloud
    codec = LinearGroupCodec(epsilon, part_points=most, detail=detail)
    groups, order = codec.group(points, bits)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(points)))
    assert (np.linalg.norm(groups.positions() - points[order], axis=1) <= epsilon * (1 + 1e-15)).all()
    data = write(groups)
    for name, column in vars(read(data, bits, len(points))).items():
        np.testing.assert_array_equal(column, getattr(groups, name))
    decoded = codec.decode(data, bits, len(points)).astype(np.int64)
    assert decoded.max(initial=0) < 1 << bits
    assert (np.linalg.norm(decoded - points[order], axis=1) <= codec.error_bound * (1 + 1e-15)).all()


def test_bytes_do_not_depend_on_the_order_of_points():
    points, codec = surface(), LinearGroupCodec(10)
    encoded = codec.encode(points, 12)
    shuffled = np.random.default_rng(0).permutation(len(points))
    assert codec.encode(points[shuffled], 12).data.tobytes() == encoded.data.tobytes()


def test_a_line_byte_by_byte():
    points = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1], [4, 0, 1]])
    encoded = LinearGroupCodec(0).encode(points, 3)
    partition = [1, 2, 1, 0, 0, 1, 3, 0, 0]
    assert encoded.data.tolist() == [*partition, 2 - 1, 0, 0, 64, 128, 0b00010000]
    assert encoded.order.tolist() == [0, 3, 1, 2]


def test_epsilon_follows_local_detail():
    """A small dense patch keeps its shape, and the rest its error."""
    small = surface(500, 6, 4)
    points = np.concatenate([surface(500, 12), small])
    moved = []
    for detail in (None, 0.01):
        groups, order = LinearGroupCodec(40, detail=detail).group(points, 12)
        error = np.linalg.norm(groups.positions() - points[order], axis=1)
        moved.append([error[order < 500].mean(), error[order >= 500].mean()])
    assert moved[1][1] < moved[0][1] / 5
    assert moved[1][0] > moved[0][0] / 5


DAMAGED = {
    "no byte": [],
    "no partition and more": [0, 0],
    "a partition without kept points": [1, 0, 0, 0, 0, 0, 0, 0, 0],
    "a partition that no encoder makes": [1, 0x81, 8, 0, 0, 0, 0, 0, 0, 0],
    "a corner outside of the grid": [1, 1, 0, 8, 0, 0, 0, 0, 0],
    "offsets of more bits than the grid": [1, 1, 0, 0, 0, 0, 4, 0, 0, 0],
    "a group of a point that is not there": [1, 2, 1, 0, 0, 1, 3, 0, 0, 1, 2, 0, 64, 128, 16],
    "a group that ends at a point that is not there": [1, 2, 1, 0, 0, 1, 3, 0, 0, 1, 0, 1, 64, 128, 16],
    "more inner points than a partition holds": [1, 2, 1, 0, 0, 1, 3, 0, 0, 0x80, 8, 0, 0, 64, 128, 16],
    "a parameter too few": [1, 2, 1, 0, 0, 1, 3, 0, 0, 1, 0, 0, 64, 16],
    "a byte behind the last": [1, 2, 1, 0, 0, 1, 3, 0, 0, 1, 0, 0, 64, 128, 16, 0],
    "a bit behind the last": [1, 2, 1, 0, 0, 1, 3, 0, 0, 1, 0, 0, 64, 128, 17],
    "an offset out of the grid": [1, 2, 1, 4, 0, 1, 3, 0, 0, 1, 0, 0, 64, 128, 16],
    "more partitions than bytes": [100, 1],
}


@pytest.mark.parametrize("data", DAMAGED.values(), ids=DAMAGED.keys())
def test_damaged_data_is_one_clear_error(data):
    with pytest.raises(CodecError, match="coded points: found"):
        LinearGroupCodec(0).decode(np.array(data, np.uint8), 3, 10**6)


def test_more_points_than_the_caller_allows():
    data = LinearGroupCodec(0).encode(np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1], [4, 0, 1]]), 3).data
    assert len(read(data, 3, 4)) == 4
    with pytest.raises(CodecError, match="found 4 points, expected at most 3"):
        read(data, 3, 3)


@pytest.mark.parametrize(
    "values",
    [(-1,), (np.nan,), (np.inf,), (1, -0.1), (1, np.nan), (1, None, 1), (1, None, 1025), (1, None, 64, 0)],
)
def test_settings_out_of_range(values):
    names = dict(zip(("detail", "part_points", "most_ends"), values[1:], strict=False))
    with pytest.raises(CodecError, match="linear groups: found"):
        LinearGroupCodec(values[0], **names)


@given(
    seed=st.integers(0, 2**32 - 1),
    log_scales=st.tuples(*[st.floats(-12, 12)] * 3),
    shift=st.floats(-1e6, 1e6),
)
@settings(deadline=None, max_examples=60)
def test_affine_maps_move_points_by_no_more_than_they_stretch(seed, log_scales, shift):
    """Also where one axis is stretched 1e24 times as much as another, or nearly vanishes."""
    rng = np.random.default_rng(seed)
    rotations = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2)]
    linear = rotations[0] * 10.0 ** np.array(log_scales) @ rotations[1]
    points, epsilon = surface(400, 10, seed % 7), 8.0
    groups, order = LinearGroupCodec(epsilon, part_points=64).group(points, 10)
    assert len(groups.parameter) > 100
    found = groups.transformed(np.column_stack([linear, np.full(3, shift)]))
    error = np.linalg.norm(found - (points[order] @ linear.T + shift), axis=1)
    stretch = np.linalg.norm(linear, 2)
    rounding = 2.0**-49 * (2**11 * stretch + abs(shift))
    assert (error <= epsilon * stretch + rounding).all()


def test_projective_maps_are_divided_point_by_point():
    """Interpolated homogeneous coordinates are those of the interpolated points, however steep the perspective."""
    groups, _ = LinearGroupCodec(30).group(surface(1000, 10), 10)
    matrix = np.array([[1.0, 0.2, 0, 5], [0, 1, 0.3, -7], [0, 0.9, 0.1, 3]])
    x, y, w = groups.transformed(matrix).T
    expected = groups.positions() @ matrix[:, :3].T + matrix[:, 3]
    np.testing.assert_allclose(np.stack([x / w, y / w]), (expected[:, :2] / expected[:, 2:]).T, rtol=1e-12)
    assert w.max() / w.min() > 20


def test_more_than_half_of_the_points_of_a_scan_go(data_dir):
    """The paper's figure: 55 % at ε = 0.5 % of the object."""
    from plyfile import PlyData

    vertex = PlyData.read(data_dir / "models" / "stanford-bunny_35947.ply")["vertex"]
    positions = np.column_stack([vertex[axis] for axis in "xyz"]).astype(np.float64)
    positions -= positions.min(axis=0)
    points = np.minimum(positions / positions.max() * 2**16, 2**16 - 1).astype(np.int64)
    groups, _ = LinearGroupCodec(0.005 * 2**16, part_points=64).group(points, 16)
    assert len(groups.parameter) > 0.7 * len(points)
