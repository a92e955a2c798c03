"""Palettes of cells: exact where colours are few, else about as near as 256 can be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.codecs.palette import MOST_COLOURS, divide_colours, to_palette
from splatpipe.shared.points import pack_rgb, unpack_rgb


def divided(rgb):
    """The boxes of ``divide_colours``, as lists of colours."""
    boxes = [rgb.astype(float)]
    while len(boxes) < MOST_COLOURS:
        spread = np.array([((box - box.mean(axis=0)) ** 2).sum(axis=0) for box in boxes])
        widest = spread.sum(axis=1).argmax()
        axis = spread[widest].argmax()
        if np.ptp(boxes[widest][:, axis]) == 0:
            break
        box = boxes[widest]
        low = box[:, axis] <= box[:, axis].mean()
        boxes[widest] = box[low]
        boxes.append(box[~low])
    return boxes


@pytest.mark.parametrize("seed", range(5))
def test_boxes_are_those_of_the_twin(seed):
    rng = np.random.default_rng(seed)
    rgb = np.clip(rng.normal(120, [40, 25, 10], (3000, 3)), 0, 255).astype(np.uint8)
    colours, index = divide_colours(rgb)
    boxes = divided(rgb)
    assert len(colours) == len(boxes) == MOST_COLOURS
    for i, box in enumerate(boxes):
        assert sorted(map(tuple, rgb[index == i].tolist())) == sorted(map(tuple, box.astype(int).tolist()))
        assert np.abs(colours[i] - box.mean(axis=0)).max() <= 0.5 + 1e-9


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=300), st.integers(0, 1000))
def test_few_colours_are_exact(some, seed):
    chosen = np.random.default_rng(seed).choice(np.array(some[:256], np.uint32), 400)
    palette, index = to_palette(chosen)
    np.testing.assert_array_equal(palette[index], chosen)


def test_fewer_boxes_where_colours_are_fewer():
    rgb = np.random.default_rng(1).integers(0, 5, (2000, 3)).astype(np.uint8)
    colours, index = divide_colours(rgb)
    assert len(colours) == 125
    np.testing.assert_array_equal(colours[index], rgb)


def test_the_error_is_at_most_that_of_median_cut():
    image = pytest.importorskip("PIL.Image")
    rng = np.random.default_rng(2)
    at = rng.uniform(0, 1, (6000, 2))
    rgb = np.column_stack([200 * at[:, 0], 120 + 60 * np.sin(9 * at[:, 1]), 90 * at.prod(axis=1)])
    rgb = np.clip(rgb + rng.normal(0, 4, rgb.shape), 0, 255).astype(np.uint8)
    palette, index = to_palette(pack_rgb(*rgb.T))
    found = unpack_rgb(palette[index])
    cut = image.fromarray(rgb[None]).quantize(MOST_COLOURS, image.Quantize.MEDIANCUT).convert("RGB")
    assert (found[:, 3] == 255).all()
    error = [((other.astype(float) - rgb) ** 2).mean() for other in (found[:, :3], np.asarray(cut)[0])]
    assert error[0] <= error[1]
