"""Layers: boxes in their octree, stored layers, what is chosen of them."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layer_example import look_at_box, random_cuboids
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.frustum import frustum_planes
from splatpipe.nodes.layer_sampling import LayerSamplingNode
from splatpipe.shared.errors import InputError, MessageError, StoreError
from splatpipe.shared.layers.box_octree import box_octree
from splatpipe.shared.layers.cuboids import OBJECT
from splatpipe.shared.layers.layer import simple_layer
from splatpipe.shared.layers.layer_store import open_layer, write_layer
from splatpipe.shared.messages import VisibilityBits


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32), n=st.integers(1, 400), capacity=st.integers(1, 40), far=st.sampled_from([0.0, 6e6]))
def test_every_box_lies_in_its_cell_and_cells_in_their_parents(seed, n, capacity, far):
    rng = np.random.default_rng(seed)
    lower = far + rng.uniform(-100, 100, (n, 3)) * rng.choice([1.0, 0.01, 0.0], (n, 1))
    upper = lower + rng.exponential(rng.choice([0.0, 0.1, 30.0]), (n, 3))
    octree, order = box_octree(lower, upper, capacity)
    assert sorted(order) == list(range(n))
    owner = np.repeat(np.arange(len(octree)), octree.n_points)
    slack = 1e-9 * octree.edge + 4 * np.spacing(np.abs(upper).max())
    half = octree.half_edges[owner, None] + slack
    assert (octree.centers[owner] - half <= lower[order]).all()
    assert (octree.centers[owner] + half >= upper[order]).all()
    assert octree.n_points.sum() == n == octree.n_below[0]
    inner = np.flatnonzero(octree.first_child >= 0)
    for cell in inner:
        children = np.arange(octree.first_child[cell], octree.first_child[cell] + octree.n_children[cell])
        assert (octree.parent[children] == cell).all()
        assert octree.n_below[children].sum() + octree.n_points[cell] == octree.n_below[cell]
    assert np.array_equal(octree.first_point, np.cumsum(octree.n_points) - octree.n_points)
    again, same = box_octree(lower[order], upper[order], capacity)
    assert np.array_equal(same, np.arange(n))
    assert np.array_equal(again.code, octree.code)


def test_what_is_left_out_has_no_corner_in_the_image():
    layer = random_cuboids(3000, seed=3)
    lower, upper = layer.bounds
    corners = np.stack([np.where([k & 1, k & 2, k & 4], upper, lower) for k in range(8)], axis=1)
    for seed in range(12):
        camera = look_at_box(lower.min(axis=0), upper.max(axis=0), seed)
        bits = CullingNode(layer.octree, backface=False).process(camera)
        entries = LayerSamplingNode(layer.octree, detail_px=0).process(camera, bits).entries
        assert (np.diff(entries["offset"].astype(np.int64)) > 0).all()
        drawn = np.zeros(len(layer), bool)
        for entry in entries:
            drawn[int(entry["offset"]) : int(entry["offset"]) + int(entry["range"])] = True
        planes = frustum_planes(camera, 0.0)
        inside = ((corners - camera.eye) @ planes[:, :3].T >= planes[:, 3]).any(axis=1)  # per plane: a corner this side
        seen = ((corners - camera.eye) @ planes[:, :3].T >= planes[:, 3]).all(axis=2).any(axis=1)
        assert inside.shape == (len(layer), 5)
        assert drawn[seen].all()
        assert not drawn.all() or seen.any()


def test_small_cells_are_left_out_from_a_distance_and_their_ancestors_kept():
    layer = random_cuboids(3000, seed=4)
    lower, upper = layer.bounds
    camera = look_at_box(lower.min(axis=0), upper.max(axis=0), 1)
    every = VisibilityBits.pack(camera.frame, np.ones(len(layer.octree), np.uint8))
    drawn = [LayerSamplingNode(layer.octree, detail_px=px).process(camera, every).n_points for px in (0, 10, 20, 4096)]
    assert drawn[0] == len(layer)
    assert drawn == sorted(drawn, reverse=True)
    assert 0 < drawn[2] < drawn[0], drawn
    with pytest.raises(MessageError, match="visibility bits"):
        LayerSamplingNode(layer.octree, detail_px=0).process(camera, VisibilityBits(camera.frame, 3, every.bits[:1]))


def test_a_layer_survives_the_disk(tmp_path):
    layer = random_cuboids(500, origin=(6e6, 5e6, 100.0))
    write_layer(layer, tmp_path / "a.layer")
    again = open_layer(tmp_path / "a.layer")
    assert np.array_equal(again.objects, layer.objects)
    assert np.array_equal(again.origin, layer.origin)
    with pytest.raises(InputError, match="exists"):
        write_layer(layer, tmp_path / "a.layer")
    write_layer(layer, tmp_path / "a.layer", overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.layer"]
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match="not a layer"):
        write_layer(layer, tmp_path / "other", overwrite=True)


def damaged(folder, how):
    objects, told = folder / "objects.npy", folder / "layer.json"
    content = json.loads(told.read_text())
    match how:
        case "cut":
            objects.write_bytes(objects.read_bytes()[:-5])
        case "longer":
            objects.write_bytes(objects.read_bytes() + b"x")
        case "bit":
            data = bytearray(objects.read_bytes())
            data[-9] ^= 4
            objects.write_bytes(data)
        case "count":
            content["arrays"]["objects"]["n"] = 2**39
        case "kind":
            content["kind"] = "spheres"
        case "origin":
            content["origin"] = [0, 0, 1e999]
        case "version":
            content["format_version"] = 2
        case "text":
            told.write_text("{")
            return
        case "gone":
            objects.unlink()
        case "order":
            array = np.load(objects)[::-1].copy()
            np.save(objects, array)
            import zlib

            content["arrays"]["objects"]["crc32"] = zlib.crc32(array.view(np.uint8).data)
    told.write_text(json.dumps(content))


@pytest.mark.parametrize("how", ["cut", "longer", "bit", "count", "kind", "origin", "version", "text", "gone", "order"])
def test_a_damaged_layer_is_refused_in_one_line(tmp_path, how):
    write_layer(random_cuboids(900), tmp_path / "a.layer")
    damaged(tmp_path / "a.layer", how)
    with pytest.raises((StoreError, InputError)) as found:
        _ = open_layer(tmp_path / "a.layer").octree
    assert "\n" not in str(found.value)
    assert "a.layer" in str(found.value) or "random" in str(found.value)


@pytest.mark.parametrize(("attribute", "value"), [("center", np.nan), ("value", np.inf), ("extent", -1.0)])
def test_attributes_nothing_can_be_drawn_from_are_refused_by_name(attribute, value):
    objects = np.zeros(3, OBJECT)
    objects[attribute][1] = value
    with pytest.raises(InputError, match=attribute):
        simple_layer("x", "cuboids", np.zeros(3), objects)
    with pytest.raises(InputError, match="no object"):
        simple_layer("x", "cuboids", np.zeros(3), objects[:0])
