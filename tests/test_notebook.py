"""The notebook widget, driven by the events that its page sends, without a page."""

import asyncio
import math

import numpy as np
import pytest
from splatpipe.cluster.api import open_scene
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.synth import CityScan

pytest.importorskip("jupyter_rfb", reason="jupyter_rfb is missing: splatpipe[notebook]")
WIDTH, HEIGHT = 160, 100


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("notebook") / "city.scene"
    build_scene([CityScan(n_points=20_000)], path, settings=BuildSettings(points_per_cell=500))
    return path


@pytest.fixture
def widget(scene, capsys):
    from splatpipe.cluster.notebook import Widget

    settings = {"render.rasterizer": "cpu", "render.point_size_px": 2}
    with open_scene(scene, width=WIDTH, height=HEIGHT, settings=settings) as view:
        widget = Widget(view)
        send(widget, "resize", width=WIDTH, height=HEIGHT, pwidth=WIDTH, pheight=HEIGHT, ratio=1.0)
        yield widget
        widget.close()


def send(widget, kind, **fields):
    """As the page does: through the handler of messages."""
    widget._rfb_handle_msg(widget, {"type": kind, "modifiers": [], **fields}, [])
    assert not widget._output_context.outputs, widget._output_context.outputs


def drag(widget, path, button=1, modifiers=()):
    x, y = path[0]
    send(widget, "pointer_down", x=x, y=y, button=button, buttons=[button], modifiers=list(modifiers))
    for x, y in path[1:]:
        send(widget, "pointer_move", x=x, y=y, button=0, buttons=[button], modifiers=list(modifiers))


def place_in_picture(widget, place):
    camera = widget.camera
    u, v, w = camera.pixel_from_world[:, :3] @ (np.asarray(place) - camera.eye)
    return np.array([u, v]) / w


def test_the_first_picture_is_that_of_the_api(widget):
    frame = widget.get_frame()
    assert frame.shape == (HEIGHT, WIDTH, 4)
    assert np.array_equal(frame, widget.view.render(widget.view.orbit()))
    assert (widget.css_width, widget.css_height, widget.quality) == ("160px", "100px", 100)


def test_a_drag_turns_small_jpegs_while_it_moves_and_a_png_in_full_when_it_ends(widget):
    async def act():
        before = widget.get_frame()
        drag(widget, [(80, 50), (100, 50), (120, 60)])
        widget._scale.step = 4  # as after pictures that took too long
        moving = widget.get_frame()
        assert moving.shape == (HEIGHT / 2, WIDTH / 2, 4)
        assert widget.quality == 75
        send(widget, "pointer_up", x=120, y=60, button=1, buttons=[])
        still = widget.get_frame()
        assert still.shape == before.shape
        assert (still != before).any()
        assert widget.quality == 100

    azimuth_rad, elevation_rad = widget.orbit.azimuth_rad, widget.orbit.elevation_rad
    asyncio.run(act())
    assert widget.orbit.azimuth_rad == pytest.approx(azimuth_rad - math.pi * 0.4)
    assert widget.orbit.elevation_rad == pytest.approx(elevation_rad + math.pi * 0.1)


def test_pictures_that_take_too_long_become_smaller(widget, monkeypatch):
    monkeypatch.setattr("splatpipe.cluster.notebook.FPS", 1e9)

    async def act():
        sizes = []
        for x in range(80, 120, 4):
            drag(widget, [(x, 50), (x + 4, 50)])
            sizes.append(widget.get_frame().shape[0])
        assert sizes == sorted(sizes, reverse=True)
        assert sizes[-1] == HEIGHT / 4
        widget._rest()

    asyncio.run(act())


def test_after_the_last_motion_the_picture_is_drawn_in_full_by_itself(widget, monkeypatch):
    monkeypatch.setattr("splatpipe.cluster.notebook.STILL_S", 0.01)

    async def act():
        send(widget, "wheel", x=80, y=50, dx=0, dy=-200, buttons=[])
        assert widget._moving
        widget._rfb_draw_requested = False
        while widget._moving:
            await asyncio.sleep(0.01)
        assert widget._rfb_draw_requested

    asyncio.run(act())


def test_panning_and_zooming_keep_what_is_under_the_pointer(widget):
    target = widget.orbit.target.copy()
    for button, modifiers in ((2, ()), (3, ()), (1, ("Shift",))):
        before = place_in_picture(widget, target)
        drag(widget, [(60, 40), (75, 32)], button, modifiers)
        assert place_in_picture(widget, target) == pytest.approx(before + np.array([15, -8]), abs=1e-6)
    height = 2 * widget.orbit.distance * math.tan(widget.orbit.fov_y_rad / 2)
    pose = widget.orbit.pose()
    under = widget.orbit.target + height * (0.3 * pose[:3, 0] + 0.2 * pose[:3, 1])
    at = place_in_picture(widget, under)
    distance = widget.orbit.distance
    send(widget, "wheel", x=at[0], y=at[1], dx=0, dy=-300, buttons=[])
    assert widget.orbit.distance < 0.8 * distance
    assert place_in_picture(widget, under) == pytest.approx(at, abs=1e-6)


def test_a_double_click_makes_the_point_the_middle(widget):
    send(widget, "double_click", x=100, y=55, button=1, buttons=[])
    assert widget.picked["attributes"]["depth"] > 0
    position = widget.picked["position"]
    assert place_in_picture(widget, position) == pytest.approx([WIDTH / 2, HEIGHT / 2], abs=1e-6)
    orbit = widget.orbit
    send(widget, "double_click", x=1, y=1, button=1, buttons=[])
    assert widget.picked is None
    assert widget.orbit is orbit


def test_keys(widget):
    first = widget.orbit
    for key, modifiers in (
        ("ArrowLeft", ()),
        ("ArrowUp", ()),
        ("ArrowUp", ("Shift",)),
        ("+", ()),
        ("w", ()),
        ("D", ()),
    ):
        before = widget.camera.clip_from_world
        send(widget, "key_down", key=key, modifiers=list(modifiers))
        assert not np.allclose(widget.camera.clip_from_world, before), key
    before = widget.orbit
    send(widget, "key_down", key="F5")
    assert widget.orbit is before
    send(widget, "key_down", key="Home")
    assert np.array_equal(widget.orbit.pose(), first.pose())


def test_the_pole_is_the_end_of_a_drag_and_the_picture_stays_upright(widget):
    for y in (50, 500, 5000, -9000, -20000):
        drag(widget, [(80, 50), (81, y)])
        assert abs(widget.orbit.elevation_rad) <= math.pi / 2
        assert widget.orbit.pose()[:3, 1] @ widget.view.up >= -1e-12
        assert widget.get_frame().shape == (HEIGHT, WIDTH, 4)


def test_it_follows_the_size_and_sharpness_of_its_page(widget):
    send(widget, "resize", width=60, height=50, pwidth=120, pheight=100, ratio=2.0)
    assert widget.get_frame().shape == (100, 120, 4)
    send(widget, "resize", width=1, height=0, pwidth=1, pheight=0, ratio=1.0)
    assert widget.get_frame().shape == (16, 16, 4)


def test_settings_and_other_errors_come_as_they_are(widget, scene):
    before = widget.get_frame()
    widget.set({"render.colour": "elevation"})
    assert (widget.get_frame() != before).any()
    with pytest.raises(ConfigError, match=r"render\.colour"):
        widget.set({"render.colour": "heat"})


def test_a_scene_that_it_has_opened_is_closed_with_it(scene, capsys):
    from splatpipe.cluster.notebook import Widget

    widget = Widget(scene, css_width="300px")
    assert widget.css_width == "300px"
    assert widget.get_frame().shape == (500, 800, 4)
    widget.close()
    with pytest.raises(InputError, match="has been closed"):
        widget.view.render()


def test_pictures_go_out_as_jpeg_and_png(widget, monkeypatch):
    sent = []
    monkeypatch.setattr(
        widget, "send", lambda header, buffers: sent.append((header["mimetype"], bytes(buffers[0][:4])))
    )

    async def act():
        widget._has_visible_views = True
        drag(widget, [(80, 50), (100, 50)])
        await asyncio.sleep(0.01)
        send(widget, "pointer_up", x=100, y=50, button=1, buttons=[])
        await asyncio.sleep(0.01)

    asyncio.run(act())
    assert [kind for kind, _ in sent] == ["image/jpeg", "image/png"]
    assert (sent[0][1][:2], sent[1][1]) == (b"\xff\xd8", b"\x89PNG")
