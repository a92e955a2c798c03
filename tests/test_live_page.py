"""The page of a live run in a real browser, before the real hub and a run that only draws (``fake_run``)."""

from __future__ import annotations

import base64
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_run import LOWER, UPPER, FakeRun, FakeServices
from PIL import Image

pytest.importorskip("aiohttp", reason="the page needs aiohttp: pip install splatpipe[live]")
pytest.importorskip("zmq", reason="the hub needs pyzmq: pip install splatpipe[live]")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install splatpipe[test]")
CHROMIUM = shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("chromium is not on the path (Debian: apt install chromium)", allow_module_level=True)

from splatpipe.cluster.live.hub import Hub  # noqa: E402
from splatpipe.cluster.live.sockets import RunLink  # noqa: E402
from splatpipe.shared.build import BuildSettings, build_scene  # noqa: E402
from splatpipe.shared.keyframes import Key, KeyframePath  # noqa: E402
from splatpipe.shared.synth import CityScan  # noqa: E402

OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
           "--disable-component-update", "--disable-sync"]  # fmt: skip
WIDTH, HEIGHT = 800, 496
PAGE_FILES = Path(__file__).parents[1] / "cluster" / "live" / "page"


@contextmanager
def live(directory: Path) -> Iterator[tuple[Hub, FakeRun]]:
    run = FakeRun()
    with Hub(FakeServices(run), connection=directory / "connection.json") as hub:
        run.link = RunLink(hub.run_address, 0, "render", "here")
        with run:
            yield hub, run


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        yield found
        found.close()


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Hub, FakeRun]]:
    with live(tmp_path_factory.mktemp("live")) as both:
        yield both


@pytest.fixture
def hub(stage: tuple[Hub, FakeRun]) -> Hub:
    return stage[0]


@pytest.fixture
def run(stage: tuple[Hub, FakeRun]) -> FakeRun:
    stage[1].reset()
    return stage[1]


@pytest.fixture
def visit(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens a page at an address once it shows a picture of its own size; at the end: no errors, none of the CSP."""
    errors: list[str] = []
    with ExitStack() as open_pages:

        def visit(url: str, width: int = WIDTH, height: int = HEIGHT, start_s: float = 15, **context: Any) -> Any:
            made = browser.new_context(
                viewport={"width": width, "height": height}, reduced_motion="reduce", accept_downloads=True, **context
            )
            open_pages.callback(made.close)
            page = made.new_page()
            page.set_default_timeout(15_000)
            page.on(
                "console", lambda message: errors.append(message.text) if message.type in ("error", "warning") else None
            )
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(url)
            until(
                page,
                "window.splatpipe?.picture.shown?.still && splatpipe.picture.wanted(1920)[0] == splatpipe.picture.shown.width",
                start_s,
            )
            return page

        yield visit
    assert errors == []


@pytest.fixture(scope="module")
def modules(browser: Any, stage: tuple[Hub, FakeRun]) -> Iterator[Any]:
    """A page whose modules can be imported."""
    page = browser.new_page()
    page.goto(stage[0].url)
    yield page
    page.close()


@pytest.fixture
def page(visit: Callable[..., Any], hub: Hub, run: FakeRun) -> Any:
    return visit(hub.url)


def until(page: Any, condition: str, timeout_s: float = 15.0) -> Any:
    """Waits for an expression of the page to be true. ``wait_for_function`` would need what the CSP forbids."""
    end = time.monotonic() + timeout_s
    while not (found := page.evaluate(condition)):
        assert time.monotonic() < end, f"waited {timeout_s} s for {condition}"
        page.wait_for_timeout(25)
    return found


def holds(page: Any, condition: Callable[[], Any], timeout_s: float = 15.0) -> None:
    """Waits for something on this side, while the page goes on."""
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        page.wait_for_timeout(25)


def at_rest(page: Any) -> int:
    """Waits until the picture shows the page's camera and is a still one; its frame."""
    until(page, "(() => { const v = splatpipe.picture.shown, w = splatpipe.cameras.viewOf(splatpipe.camera);"
                " return v.still && v.view.eye.every((x, i) => Math.abs(x - w.eye[i]) < 1e-6); })()")  # fmt: skip
    return page.evaluate("splatpipe.picture.shown.frame")


def pixels(page: Any) -> np.ndarray:
    data = page.evaluate("splatpipe.picture.canvas.toDataURL().split(',')[1]")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


def changed_share(page: Any, before: np.ndarray) -> float:
    """Of the pixels that differ; 0 while the picture has another size, as while something moves."""
    now = pixels(page)
    return float(np.mean(np.any(now != before, axis=2))) if now.shape == before.shape else 0.0


def drag(page: Any, start: tuple[float, float], end: tuple[float, float], button: str = "left") -> None:
    page.mouse.move(*start)
    page.mouse.down(button=button)
    page.mouse.move(*end, steps=6)
    until(page, "!splatpipe.unsent")
    page.mouse.up(button=button)


def places(page: Any, points: list[list[float]]) -> np.ndarray:
    """Where the picture that is shown has points of the world: CSS pixels of the window."""
    found = page.evaluate(
        "points => points.map(p => splatpipe.picture.pixel(splatpipe.cameras.project(splatpipe.picture.shown.view,"
        " splatpipe.picture.aspect, p)))",
        points,
    )
    return np.array(found, float)


def visible_points(page: Any, run: FakeRun, n: int) -> np.ndarray:
    """(n, 3) points that a click at their place finds, apart from each other and beside all panels."""
    view = page.evaluate("splatpipe.picture.shown.view")
    width, height = page.evaluate("[innerWidth, innerHeight]")
    at, depth = run.project(view["eye"], view["target"], view["up"], view["fov_deg"], width, height)
    found: list[int] = []
    open_to_clicks = (at > [330, 80]).all(axis=1) & (at < [width - 350, height - 80]).all(axis=1) & (depth > 0)
    for i in np.flatnonzero(open_to_clicks):
        apart = all(np.hypot(*(at[i] - at[j])) > 40 for j in found)
        if apart and depth[i] == depth[np.hypot(*(at - at[i]).T) < 8].min():
            found.append(int(i))
            if len(found) == n:
                return run.points[found]
    raise AssertionError("too few")


def test_a_picture_of_the_windows_size_appears_and_the_token_leaves_the_address(page, run):
    assert pixels(page).shape == (HEIGHT, WIDTH, 3)
    assert len(np.unique(pixels(page).reshape(-1, 3), axis=0)) > 100
    assert "token" not in page.url
    assert page.title() == "valley & village – splatpipe"
    assert page.locator("#notice").is_hidden()
    page.reload()
    until(page, "window.splatpipe?.picture.shown")


def test_a_drag_turns_the_camera_and_changes_the_picture(page, run):
    before, view = pixels(page), page.evaluate("splatpipe.picture.shown.view")
    run.cameras = []
    drag(page, (350, 240), (450, 260))
    holds(page, lambda: run.cameras and not run.cameras[-1]["moving"])
    at_rest(page)
    assert run.cameras[0]["moving"]
    assert len({camera["t"] for camera in run.cameras}) == len(run.cameras)
    after = page.evaluate("splatpipe.picture.shown.view")
    assert after["target"] == view["target"]
    assert np.linalg.norm(np.subtract(after["eye"], after["target"])) == pytest.approx(
        np.linalg.norm(np.subtract(view["eye"], view["target"])), rel=1e-10
    )
    assert changed_share(page, before) > 0.1
    assert page.evaluate("splatpipe.latencies.length") > 0


def test_pictures_out_of_order_and_broken_ones_are_acknowledged_and_not_shown(page, run):
    frame, acknowledged = page.evaluate("""async () => {
        const { picture } = splatpipe, acknowledge = picture.acknowledge, acknowledged = [];
        picture.acknowledge = frame => acknowledged.push(frame);
        const small = Object.assign(document.createElement('canvas'), { width: 8, height: 8 });
        small.getContext('2d').fillRect(0, 0, 1, 1);
        const png = new Uint8Array(await (await new Promise(done => small.toBlob(done))).arrayBuffer());
        const header = { encoding: 'png', view: picture.shown.view, still: true, scale: 1 };
        await picture.accept({ ...header, frame: picture.shown.frame - 1 }, png);
        await picture.accept({ ...header, frame: picture.shown.frame + 1 }, png.slice(0, 40));
        picture.acknowledge = acknowledge;
        return [picture.shown.frame, acknowledged];
    }""")
    assert acknowledged == [frame - 1, frame + 1]
    assert pixels(page).shape == (HEIGHT, WIDTH, 3)


def test_the_wheel_keeps_the_point_under_the_cursor_and_ends_still(page, run):
    point = visible_points(page, run, 1)[0].tolist()
    start = places(page, [point])[0]
    page.mouse.move(*start)
    page.mouse.wheel(0, -100)
    page.wait_for_timeout(120)  # the answer to what lies there
    distance = page.evaluate("splatpipe.camera.distance")
    here = places(page, [point])[0]
    for _ in range(3):
        page.mouse.wheel(0, -100)
        page.wait_for_timeout(30)
    holds(page, lambda: not run.cameras[-1]["moving"])
    at_rest(page)
    assert page.evaluate("splatpipe.camera.distance") < 0.8 * distance
    assert places(page, [point])[0] == pytest.approx(here, abs=40)  # exact once the hub has said what lies there


def test_keys_steer_and_open(page, run):
    page.keyboard.press("1")
    at_rest(page)
    view = page.evaluate("splatpipe.picture.shown.view")
    assert view["eye"][2] - view["target"][2] > 0.999 * np.linalg.norm(np.subtract(view["eye"], view["target"]))
    assert np.allclose(view["up"], [0, 1, 0], atol=1e-4)
    page.keyboard.press("r")
    at_rest(page)
    assert np.allclose(page.evaluate("splatpipe.picture.shown.view.target"), (LOWER + UPPER) / 2)
    page.keyboard.press("g")
    eye = np.array(page.evaluate("splatpipe.picture.shown.view.eye"))
    page.keyboard.down("w")
    until(page, f"splatpipe.cameras.viewOf(splatpipe.camera).eye[1] > {eye[1]}")
    page.keyboard.up("w")
    at_rest(page)
    assert page.evaluate("splatpipe.picture.shown.view.eye[1]") > eye[1]
    page.keyboard.press("?")
    assert page.locator("#help").is_visible()
    page.keyboard.press("Escape")
    page.keyboard.press("h")
    assert page.locator("#status").is_hidden()


def test_a_double_click_makes_the_point_the_centre(page, run):
    point = visible_points(page, run, 1)[0]
    page.mouse.dblclick(*places(page, [point.tolist()])[0])
    until(page, f"Math.abs(splatpipe.camera.target[0] - {point[0]}) < 1e-6")
    at_rest(page)
    assert places(page, [point.tolist()])[0] == pytest.approx([WIDTH / 2, HEIGHT / 2], abs=1e-3)


def test_a_setting_changes_the_run_and_the_picture_and_a_group_is_reset(page, run):
    before = pixels(page)
    page.locator("#set-render-point_size_px").fill("5")
    page.locator("#set-render-point_size_px").press("Enter")
    holds(page, lambda: run.settings["render.point_size_px"] == 5)
    page.get_by_label("Colour", exact=True).select_option("classification")
    holds(page, lambda: run.settings["render.colour"] == "classification")
    until(page, "splatpipe.settings['render.colour'] == 'classification'")
    holds(page, lambda: changed_share(page, before) > 0.1)
    page.locator("summary", has_text="Filter").click()
    page.get_by_role("checkbox", name="water").uncheck()
    holds(page, lambda: run.settings["filter.classes"] == [2, 5, 6])
    page.get_by_label("Clip box", exact=True).check()
    holds(page, lambda: len(run.settings["filter.boxes"]) == 1)
    box = run.settings["filter.boxes"][0]
    assert (np.array(box["lower"]) < LOWER).all()
    assert (np.array(box["upper"]) > UPPER).all()
    until(page, "document.querySelectorAll('#overlay .box path').length == 2")
    page.get_by_role("button", name="Reset filter").click()
    holds(page, lambda: run.settings["filter.classes"] == [] and run.settings["filter.boxes"] == [])
    until(page, "document.querySelectorAll('#overlay .box').length == 0")
    assert page.get_by_role("checkbox", name="water").is_checked()


def test_a_refused_setting_is_explained_and_put_back(page, run):
    run.refuse = "sampling.pixel_threshold"
    field = page.locator("#set-sampling-pixel_threshold")
    field.fill("12")
    field.press("Enter")
    page.get_by_text("sampling.pixel_threshold: not today").wait_for()
    until(page, "document.querySelector('#set-sampling-pixel_threshold').value == '32'")


def test_a_screenshot_of_any_size_is_saved(page, run):
    page.keyboard.press("x")
    page.get_by_label("Width in pixels").fill("1001")
    page.get_by_label("Height in pixels").fill("503")
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Save picture").click()
    assert re.fullmatch(r"valley-village-\d{8}-\d{6}\.png", waiting.value.suggested_filename)
    with Image.open(waiting.value.path()) as image:
        assert image.format == "PNG"
        assert image.size == (1001, 503)


def test_picking_shows_position_and_attributes(page, run):
    page.keyboard.press("p")
    point = visible_points(page, run, 1)[0]
    page.mouse.click(*places(page, [point.tolist()])[0])
    card = page.locator("#card")
    card.get_by_text("classification").wait_for()
    text = card.inner_text()
    for value in point:
        assert f"{value:.3f} m" in text
    assert "1234" in text
    assert page.locator("#overlay .pick circle").count() == 1


def test_a_distance_is_right_and_its_line_stays_at_its_points(page, run):
    page.keyboard.press("l")
    points = visible_points(page, run, 3)
    for n, at in enumerate(places(page, points.tolist())):
        page.mouse.click(*at)
        until(page, f"document.querySelectorAll('#overlay .measure circle').length == {n + 1}")
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert page.locator("#measured").inner_text() == f"{legs.sum():.3f} m"
    drag(page, (350, 240), (390, 250))
    at_rest(page)
    circles = page.evaluate(
        "[...document.querySelectorAll('#overlay .measure circle')].map(c => [c.cx.baseVal.value, c.cy.baseVal.value])"
    )
    assert np.allclose(circles, places(page, points.tolist()), atol=0.1)
    page.get_by_role("button", name="Clear").click()
    assert page.locator("#overlay .measure").count() == 0


def test_a_recorded_path_is_saved_as_toml(page, run):
    page.keyboard.press("c")
    page.get_by_role("button", name="Record").click()
    for x in (420, 360, 430):
        drag(page, (390, 300), (x, 310))
        page.wait_for_timeout(60)
    page.get_by_role("button", name="Stop").click()
    assert page.locator(".keys li").count() >= 3
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Save TOML").click()
    assert waiting.value.suggested_filename == "path.toml"
    keys = tomllib.loads(Path(waiting.value.path()).read_text())["camera"]["keyframes"]
    times = [key["time"] for key in keys]
    assert times[0] == 0
    assert times == sorted(set(times))
    assert len({tuple(key["eye"]) for key in keys}) >= 3
    run.cameras = []
    page.get_by_role("button", name="Play").click()
    holds(page, lambda: any(camera["moving"] for camera in run.cameras) and not run.cameras[-1]["moving"])
    page.get_by_role("button", name="Play").wait_for()


def test_the_monitor_shows_ranks_against_the_model_and_what_is_left_out(page, run):
    page.keyboard.press("m")
    page.get_by_role("img", name=re.compile(r"render: work .* ms, wait .* ms, expected 14.0 ms")).wait_for()
    assert page.locator(".rank").count() == 4
    page.locator("#chart-choice").select_option("2 memory_bytes")
    page.locator(".chart", has_text="memory_bytes").wait_for()
    page.get_by_role("button", name="Left out…").click()
    page.get_by_text("the scene has no radii").wait_for()


def test_it_comes_back_by_itself_after_a_loss(page, run, hub):
    page.evaluate("""{
        window.seen = [];
        const text = id => document.getElementById(id).textContent;
        splatpipe.connection.addEventListener('state', () =>
            seen.push([splatpipe.connection.state.name, text('notice-title'), text('state-text')]));
    }""")
    for viewer in list(hub._board._viewers.values()):
        hub._loop.call_soon_threadsafe(hub._board.leave, viewer, "takes nothing")
    until(page, "seen.length > 0")
    assert page.evaluate("seen[0]") == ["waiting", "Connection lost", "reconnecting in 1 s"]
    run.link.send({"kind": "settings", "settings": {**run.settings, "camera.width": 640}})
    run.settings["camera.width"] = 640
    until(page, "splatpipe.connection.state.name == 'open'")
    holds(page, lambda: run.settings["camera.width"] == WIDTH)
    until(page, f"splatpipe.picture.shown.width == {WIDTH}")
    assert page.locator("#notice").is_hidden()


def test_viewers_see_what_the_other_does(page, run, hub, visit):
    other = visit(hub.url)
    page.locator("#set-render-point_size_px").fill("4")
    page.locator("#set-render-point_size_px").press("Enter")
    until(other, "document.querySelector('#set-render-point_size_px').value == '4'")
    page.wait_for_timeout(450)
    drag(page, (350, 240), (440, 260))
    at_rest(page)
    eye = page.evaluate("splatpipe.picture.shown.view.eye")
    until(other, f"Math.abs(splatpipe.cameras.viewOf(splatpipe.camera).eye[0] - {eye[0]}) < 1e-3")
    assert other.evaluate("splatpipe.latencies.length") == 0


@pytest.mark.parametrize("width", [390, 360])
def test_phones_get_sheets_and_fingers(visit, hub, run, width):
    page = visit(hub.url, width, 700, has_touch=True, is_mobile=True, color_scheme="light")
    assert page.locator("#panel").is_hidden()
    page.get_by_role("button", name="Settings", exact=True).tap()
    box = page.locator("#panel").bounding_box()
    assert (box["x"], box["width"], box["y"] + box["height"]) == (0, width, 700)
    assert box["y"] > 200
    page.locator("#panel").get_by_role("button", name="Close").tap()
    assert page.evaluate("document.scrollingElement.scrollWidth") == width
    for button in page.locator("#tools button").all():
        at = button.bounding_box()
        assert at["x"] >= 0
        assert at["x"] + at["width"] <= width
    distance = page.evaluate("splatpipe.camera.distance")
    touch = page.context.new_cdp_session(page)

    def fingers(kind: str, *at: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(at)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", (150, 300))
    fingers("touchStart", (150, 300), (210, 300))
    for step in range(1, 7):
        fingers("touchMove", (150 - 10 * step, 300), (210 + 10 * step, 300))
    fingers("touchEnd")
    at_rest(page)
    assert page.evaluate("splatpipe.camera.distance") == pytest.approx(distance * 60 / 180, rel=0.1)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_contrast(modules, scheme):
    modules.emulate_media(color_scheme=scheme)
    colours = modules.evaluate(COLOURS)
    text, muted, accent, surface, raised, on_accent, tint = (_luminance(colour) for colour in colours)
    pairs = [(text, surface), (muted, surface), (accent, surface), (text, raised), (muted, raised)]
    for one, two in [*pairs, (on_accent, accent), (accent, tint)]:
        assert (max(one, two) + 0.05) / (min(one, two) + 0.05) >= 4.5
    assert (surface > text) == (scheme == "light")


COLOURS = """['--text', '--muted', '--accent', '--surface', '--raised', '--on-accent', '--tint'].map(name => {
    const probe = document.createElement('i');
    probe.style.color = `var(${name})`;
    document.body.append(probe);
    const found = getComputedStyle(probe).color.match(/[0-9.]+/g).slice(0, 3).map(Number);
    probe.remove();
    return found;
})"""


def _luminance(rgb: list[float]) -> float:
    share = np.array(rgb) / 255
    return float(np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722])


def test_it_says_so_when_the_run_has_ended(visit, tmp_path):
    with live(tmp_path) as (hub, _):
        page = visit(hub.url)
        hub.close()
        page.get_by_text("The run has ended").wait_for()
    assert page.locator("#state").inner_text() == "ended"


@pytest.mark.mpi
def test_the_page_before_three_ranks(visit, tmp_path):
    scene = tmp_path / "town.scene"
    build_scene([CityScan(n_points=50_000)], scene, settings=BuildSettings(points_per_cell=1000))
    config = tmp_path / "view.toml"
    config.write_text(
        f'[scene]\npath = "{scene}"\n[camera]\nwidth = 320\nheight = 200\n'
        '[render]\nrasterizer = "cpu"\npoint_size_px = 2\nthreads = 1\n[pipeline]\ntopology = "pipelined"\n'
    )
    command = [
        sys.executable,
        "-m",
        "splatpipe.cluster",
        "view",
        str(config),
        "--connection",
        str(tmp_path / "live.json"),
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as process:
        try:
            assert process.stdout
            said: list[str] = []
            while not (url := re.search(r"http://\S+", said[-1] if said else "")):
                said.append(process.stdout.readline())
                assert said[-1], "".join(said)
            page = visit(url[0], start_s=90)
            before = pixels(page)
            assert before.shape == (HEIGHT, WIDTH, 3)
            drag(page, (350, 240), (450, 260))
            at_rest(page)
            turned = pixels(page)
            assert changed_share(page, before) > 0.05
            page.get_by_label("Colour", exact=True).select_option("elevation")
            until(page, "splatpipe.settings['render.colour'] == 'elevation'")
            at_rest(page)
            holds(page, lambda: changed_share(page, turned) > 0.05)
            page.locator("#set-render-point_size_px").fill("99")
            page.locator("#set-render-point_size_px").press("Enter")
            page.get_by_text("render.point_size_px: found 99").wait_for()
            page.keyboard.press("Tab")
            page.keyboard.press("x")
            page.get_by_label("Width in pixels").fill("640")
            page.get_by_label("Height in pixels").fill("480")
            with page.expect_download() as waiting:
                page.get_by_role("button", name="Save picture").click()
            with Image.open(waiting.value.path()) as image:
                assert image.size == (640, 480)
            process.send_signal(signal.SIGINT)
            page.get_by_text("The run has ended").wait_for()
            assert process.wait(30) == 0
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with the ranks, where the test has failed


def test_nothing_in_the_page_is_inline_or_from_elsewhere():
    for file in PAGE_FILES.iterdir():
        text = file.read_text(encoding="utf-8")
        assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text), file.name
        if file.suffix == ".html":
            assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\sstyle=|\son[a-z]+=", text)


# --- the camera's mathematics ---------------------------------------------------------------------------------------

MATH = """async ([up, lower, upper]) => {
  const c = await import('/camera.js');
  const basis = c.basisOf(up), size = c.length(c.subtract(upper, lower)), aspect = 1.6, found = {};
  const flat = c.add(c.add(basis.a, c.times(basis.b, -2)), basis.u);
  const centre = lower.map((x, i) => (x + upper[i]) / 2);
  let camera = c.cameraOf({ eye: c.add(centre, c.times(flat, size)), target: centre, up: basis.u, fov_deg: 50 }, basis, size);
  camera = c.fit(camera, lower, upper, aspect);
  const view = c.viewOf(camera);
  found.corners = [0, 1, 2, 3, 4, 5, 6, 7].map(i => c.project(view, aspect, [0, 1, 2].map(k => i & (1 << k) ? upper[k] : lower[k])));

  // turned beyond both poles, the camera's up goes on pointing up
  let turned = camera; found.ups = []; found.distances = []; found.jumps = [];
  for (let i = 0; i < 400; i++) {
    const before = c.axesOf(c.viewOf(turned)).right;
    turned = c.orbit(turned, 0.01, i < 200 ? 0.03 : -0.03);
    const v = c.viewOf(turned);
    found.ups.push(c.dot(c.axesOf(v).up, basis.u));
    found.distances.push(c.length(c.subtract(v.eye, v.target)) / camera.distance);
    found.jumps.push(c.length(c.subtract(c.axesOf(v).right, before)));
  }
  const back = c.cameraOf(c.viewOf(turned), basis, size);
  found.back = [back.azimuth - turned.azimuth, back.elevation - turned.elevation];

  const grabbed = c.pointAt(view, aspect, [0.3, 0.7], camera.distance);
  const panned = c.pan(camera, aspect, [0.3, 0.7], [0.62, 0.41]);
  found.panned = c.project(c.viewOf(panned), aspect, grabbed);
  const anchor = c.pointAt(view, aspect, [0.8, 0.25], 0.7 * camera.distance);
  const zoomed = c.zoom(camera, 0.2, anchor);
  found.zoomed = c.project(c.viewOf(zoomed), aspect, anchor);
  found.nearer = zoomed.distance / camera.distance;
  let deep = camera; for (let i = 0; i < 500; i++) deep = c.zoom(deep, 0.8, anchor);
  found.deep = c.viewOf(deep).eye.concat(deep.distance);
  const looked = c.look(camera, 0.3, -0.1);
  found.stays = c.length(c.subtract(c.viewOf(looked).eye, view.eye)) / size;
  const centred = c.centreOn(camera, anchor);
  found.centred = c.project(c.viewOf(centred), aspect, anchor);
  found.kept_depth = centred.distance / (0.7 * camera.distance);
  const tops = Object.entries(c.AXIS_VIEWS).map(([name, [azimuth, elevation]]) => [name, c.direction({ ...camera, azimuth, elevation })]);
  found.top = c.dot(Object.fromEntries(tops).top, basis.u);
  return found;
}"""


def test_a_path_is_played_as_run_draws_it(modules):
    rng = np.random.default_rng(3)
    base = np.array([6.4e6, 1e5, 0.0])
    times = [0.0, 0.7, 1.0, 2.5, 2.6, 4.0]
    eyes, targets = base + rng.normal(0, 50, (6, 3)) + [0, -200, 80], base + rng.normal(0, 10, (6, 3))
    eyes[3], targets[3] = eyes[2], targets[2]  # where it rests
    degrees = [40, 50, 60, 60, 45, 30]
    keys = [
        {"time": t, "view": {"eye": eye.tolist(), "target": target.tolist(), "up": [0, 0, 1], "fov_deg": fov}}
        for t, eye, target, fov in zip(times, eyes, targets, degrees, strict=True)
    ]
    asked = np.linspace(-0.5, 4.5, 41)
    views = modules.evaluate(
        """async ([keys, times]) => {
            const c = await import('/camera.js');
            const basis = c.basisOf('z');
            const path = c.pathThrough(keys.map(({ time, view }) => ({ time, camera: c.cameraOf(view, basis, 300) })));
            return times.map(time => c.viewOf(path(time)));
        }""",
        [keys, asked.tolist()],
    )
    path = KeyframePath(
        tuple(Key(t, e, g, np.radians(f)) for t, e, g, f in zip(times, eyes, targets, degrees, strict=True)),
        np.array([0.0, 0.0, 1.0]),
    )
    for at, view in zip(asked, views, strict=True):
        pose = path.pose(at)
        axis = np.subtract(view["target"], view["eye"])
        assert view["eye"] == pytest.approx(pose[:3, 3], rel=0, abs=1e-6)
        assert axis / np.linalg.norm(axis) == pytest.approx(-pose[:3, 2], abs=1e-8)
        assert view["up"] == pytest.approx(pose[:3, 1], abs=1e-8)
        assert view["fov_deg"] == pytest.approx(np.degrees(path.fov_y_rad(at)))


@pytest.mark.parametrize(
    ("up", "centre", "extent"),
    [("z", 0.0, 1.0), ("y", 6.4e6, 100.0), ("-z", 6.4e6, 1.0), ("x", 0.0, 1e-6), ("-y", 0.0, 1e7), ("-x", -3.0, 5.0)],
)
def test_camera_mathematics(modules, up, centre, extent):
    lower = [centre - extent, centre - extent / 2, centre - extent / 3]
    upper = [centre + extent, centre + extent / 2, centre + extent / 3]
    found = modules.evaluate(MATH, [up, lower, upper])
    slack = max(1e-9, 1e-15 * abs(centre) / extent * 100)
    corners = np.array(found["corners"])
    assert (corners[:, 2] > 0).all()
    assert (corners[:, :2] > 0).all()
    assert (corners[:, :2] < 1).all()
    assert np.abs(corners[:, :2] - 0.5).max() > 0.4  # and not much smaller than the picture
    assert min(found["ups"]) >= -slack
    assert np.allclose(found["distances"], 1, atol=slack)
    assert max(found["jumps"]) < 0.011
    assert np.allclose(found["back"], 0, atol=1e-3 if centre else 1e-6)
    assert found["panned"][:2] == pytest.approx([0.62, 0.41], abs=slack)
    assert found["zoomed"][:2] == pytest.approx([0.8, 0.25], abs=10 * slack)
    assert found["nearer"] == pytest.approx(0.2)
    assert np.isfinite(found["deep"]).all()
    assert found["deep"][3] > 0
    assert found["stays"] < slack
    assert found["centred"][:2] == pytest.approx([0.5, 0.5], abs=slack)
    assert found["kept_depth"] == pytest.approx(1, abs=slack)
    assert found["top"] == pytest.approx(1, abs=1e-6)
