"""What the next picture of a live run is, by a clock that the test turns."""

import numpy as np
import pytest
from splatpipe.cluster.live.protocol import View
from splatpipe.cluster.live.settings import SETTABLE, changed, check_size, configured, settings_of
from splatpipe.cluster.live.steering import SCALES, Scale, Steering
from splatpipe.cluster.live.views import camera_of
from splatpipe.nodes.raster import MAX_SIDE_PX
from splatpipe.shared.config import LiveSection, RunConfig
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.messages import Use

HERE = View(eye=(0.0, 0.0, 10.0), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
THERE = HERE.model_copy(update={"eye": (1.0, 0.0, 10.0)})


def steering(viewers=1, **live):
    made = Steering(HERE, (1280, 720), LiveSection(**live))
    made.watched(viewers, 0.0)
    return made


def drawn(made, now):
    """Frames begun at a moment, each seen at once."""
    wanted = []
    while (next_one := made.next(now)) and len(wanted) < 9:
        made.started(len(wanted), now)
        made.shown(len(wanted))
        wanted.append(next_one)
    return wanted


def test_a_run_that_nobody_looks_at_rests():
    made = steering(viewers=0)
    made.looked(THERE, True, 1.0, 1, 5.0)
    assert made.next(5.0) is None
    assert made.wait_s(5.0) > 1
    made.watched(1, 6.0)
    assert made.next(6.0).view == THERE


def test_who_comes_sees_a_still_picture_and_then_nothing_is_drawn():
    made = steering()
    (first,) = drawn(made, 0.0)
    assert (first.use, first.scale, first.size) == (Use.STILL, 1.0, (1280, 720))
    assert made.next(100.0) is None
    made.watched(2, 101.0)
    assert [wanted.use for wanted in drawn(made, 101.0)] == [Use.STILL]


def test_the_latest_camera_wins_and_pictures_keep_their_distance():
    made = steering(fps=20.0)
    drawn(made, 0.0)
    for i in range(10):
        made.looked(THERE.model_copy(update={"eye": (float(i), 0.0, 10.0)}), True, float(i), 1, 1.0)
    (wanted,) = drawn(made, 1.0)
    assert wanted.view.eye[0] == wanted.t == 9.0
    assert wanted.use is Use.MOVING
    made.looked(THERE, True, 11.0, 1, 1.01)
    assert made.next(1.02) is None
    assert made.wait_s(1.02) == pytest.approx(0.03)
    assert made.next(1.05).t == 11.0


def test_when_the_camera_stands_a_whole_picture_follows_without_being_asked_for():
    made = steering(still_after_s=0.2)
    drawn(made, 0.0)
    made.scale.step = 4
    made.looked(THERE, True, 1.0, 1, 1.0)
    (moving,) = drawn(made, 1.0)
    assert (moving.scale, moving.size) == (SCALES[4], (640, 360))
    assert made.next(1.1) is None
    (still,) = drawn(made, 1.21)
    assert (still.use, still.scale, still.size) == (Use.STILL, 1.0, (1280, 720))
    assert made.next(99.0) is None


def test_the_end_of_a_motion_is_still_at_once():
    made = steering()
    made.looked(THERE, True, 1.0, 1, 1.0)
    drawn(made, 1.0)
    made.looked(THERE, False, 2.0, 1, 1.001)
    assert [wanted.use for wanted in drawn(made, 1.001)] == [Use.STILL]


def test_pictures_that_nobody_has_seen_hold_up_others_but_not_for_ever():
    made = steering(fps=100.0)
    drawn(made, 0.0)
    for i in range(3):
        made.looked(THERE, True, 0.0, 1, 1 + i / 10)
        assert made.next(1 + i / 10)
        made.started(i, 1 + i / 10)
    made.looked(THERE, True, 0.0, 1, 1.3)
    assert made.next(1.3) is None
    assert made.wait_s(1.3) == pytest.approx(0.7)
    made.shown(0)
    assert made.next(1.4)
    made.started(3, 1.4)
    made.looked(THERE, True, 0.0, 1, 1.41)
    assert made.next(1.42) is None
    assert made.next(2.2)  # the first of the unseen ones is more than a second old


def test_screenshots_come_first_at_their_size_and_few_may_wait():
    made = steering()
    taken = [made.shoot({"viewer": 3, "request": i, "width": 64, "height": 32}) for i in range(6)]
    assert taken == [True] * 4 + [False] * 2
    wanted = made.next(0.0)
    assert (wanted.use, wanted.size, wanted.screenshot) == (Use.SCREENSHOT, (64, 32), {"viewer": 3, "request": 0})
    made.watched(0, 0.0)  # who asked for them need not look
    assert [made.next(0.0).screenshot["request"] for _ in range(3)] == [1, 2, 3]


def test_scale_follows_the_time_of_pictures_and_recovers():
    scale = Scale(0.25)
    for _ in range(100):
        scale.took(0.5, 0.1)
    assert scale.now == 0.25
    for _ in range(200):
        scale.took(0.09, 0.1)
    assert scale.now == 0.25  # neither too slow nor idle
    for _ in range(200):
        scale.took(0.01, 0.1)
    assert scale.now == 1.0


def test_scale_settles_where_the_time_goes_with_the_pixels():
    """Of a picture that takes four times as long as there is, a quarter of the pixels, within two steps."""
    scale, seen = Scale(0.1), []
    for _ in range(300):
        scale.took(0.4 * scale.now**2, 0.1)
        seen.append(scale.now)
    assert 0.35 <= min(seen[100:]) <= max(seen[100:]) <= 0.5
    assert len(set(seen[100:])) <= 2


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("scene.path", "/etc/passwd", "cannot be changed in a live run"),
        ("output.directory", "/", "cannot be changed in a live run"),
        ("pipeline.topology", "single", "cannot be changed in a live run"),
        ("camera.width", 1e9, "expected 16 … 4096"),
        ("camera.width", True, "expected 16 … 4096"),
        ("render.point_size_px", "2", "expected 1 … 32"),
        ("render.edl_strength", float("nan"), "expected 0 … 4"),
        ("render.colour", "x" * 65, "expected a name"),
        ("filter.classes", {"a": 1}, "expected a list"),
        ("filter.boxes", [{}] * 9, "found 9 boxes"),
    ],
)
def test_what_may_not_be_changed_is_refused_in_one_line(key, value, said):
    with pytest.raises(ConfigError, match=said) as error:
        changed({}, {key: value})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"camera.width": 4096, "camera.height": 4096}, "at most 8,388,608"),
        ({"camera.width": 4096, "camera.height": 2048, "render.supersampling": 4}, "at most 33,554,432"),
        ({"filter.classes": [300]}, "filter.classes"),
        ({"filter.boxes": [{"lower": [0, 0], "upper": [1, 1, 1]}]}, "filter.boxes"),
        ({"render.colour_range": [1]}, "render.colour_range"),
    ],
)
def test_what_the_configuration_does_not_allow_is_refused_by_name(settings, said):
    with pytest.raises(ConfigError, match=said):
        check_size(configured(RunConfig(), changed({}, settings)), RunConfig())


def test_settings_hold_in_place_of_the_configuration_until_they_are_taken_back():
    settings = changed({}, {"render.point_size_px": 3, "filter.classes": [2]})
    config = configured(RunConfig(), settings)
    assert (config.render.point_size_px, config.filter.classes) == (3, [2])
    assert settings_of(config)["render.point_size_px"] == 3
    assert changed(settings, {"render.point_size_px": None}) == {"filter.classes": [2]}
    assert configured(RunConfig(), {}) == RunConfig()


def test_no_setting_names_a_file_a_rank_or_memory():
    sections = {key.split(".")[0] for key in SETTABLE}
    assert sections == {"camera", "sampling", "render", "filter", "live"}
    assert set(settings_of(RunConfig())) == set(SETTABLE)


def test_a_view_has_coordinates_of_which_a_camera_of_any_size_can_be_made():
    for wrong in (1e300, -1e16, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="eye"):
            View(eye=(0.0, wrong, 0.0), target=(0.0, 0.0, 0.0))
    far = View(eye=(1e15, -1e15, -0.0), target=(0.0, 0.0, 5e-324), up=(5e-324, 0.0, 0.0), fov_deg=1e-3)
    assert np.isfinite(camera_of(far, MAX_SIDE_PX, MAX_SIDE_PX, 0, 1.0).clip_from_world).all()
    with pytest.raises(InputError, match="finite"):
        camera_of(far.model_copy(update={"fov_deg": 1e-307}), MAX_SIDE_PX, MAX_SIDE_PX, 0, 1.0)


def test_a_screenshot_is_no_longer_than_any_device_can_draw():
    given = RunConfig()
    sides = {"camera.width": 16384, "camera.height": 32}
    check_size(configured(given, sides), given, screenshot=True)
    with pytest.raises(ConfigError, match="at most 16384 px a side"):
        check_size(configured(given, sides | {"render.supersampling": 2}), given, screenshot=True)
