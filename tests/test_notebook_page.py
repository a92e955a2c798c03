"""The notebook widget in a browser: its own page code, with a stand-in for the notebook's connection."""

import asyncio
import base64
from pathlib import Path

import pytest
from splatpipe.cluster.api import open_scene
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.synth import CityScan

pytest.importorskip("jupyter_rfb", reason="jupyter_rfb is missing: splatpipe[notebook]")
playwright = pytest.importorskip("playwright.async_api", reason="playwright is missing")
CHROMIUM = Path("/usr/bin/chromium")
QUIET = ["headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-sync"]
QUIET += ["disable-background-networking", "disable-component-update"]

MODEL = """
async ([code, state]) => {
    const handlers = {}
    window.model = {
        get: name => state[name],
        set: (name, value) => { state[name] = value; window.setTrait(name, value) },
        save_changes: () => {},
        on: (name, handler) => (handlers[name] ??= []).push(handler),
        off: () => {},
        send: message => window.toWidget(message),
    }
    window.fromWidget = (message, file) => {
        const bytes = Uint8Array.from(atob(file), c => c.charCodeAt(0))
        handlers['msg:custom'].forEach(handler => handler(message, [new DataView(bytes.buffer)]))
    }
    const module = await import(URL.createObjectURL(new Blob([code], { type: 'text/javascript' })))
    const widget = module.default()
    widget.initialize({ model })
    widget.render({ model, el: document.body })
}
"""


@pytest.mark.skipif(not CHROMIUM.exists(), reason=f"no {CHROMIUM}")
def test_a_drag_in_a_page_turns_the_scene(tmp_path, monkeypatch, capsys):
    from splatpipe.cluster.notebook import Widget

    build_scene([CityScan(n_points=20_000)], tmp_path / "s", settings=BuildSettings(points_per_cell=500))
    settings = {"render.rasterizer": "cpu", "render.point_size_px": 2}

    async def act(widget):
        sent = []
        async with playwright.async_playwright() as drivers:
            browser = await drivers.chromium.launch(executable_path=CHROMIUM, args=[f"--{arg}" for arg in QUIET])
            page = await browser.new_page(viewport={"width": 500, "height": 400})
            tasks = []

            def send(header, buffers):
                sent.append((header["mimetype"], widget._rfb_last_frame))
                file = base64.b64encode(buffers[0]).decode()
                tasks.append(asyncio.create_task(page.evaluate("([m, f]) => fromWidget(m, f)", [header, file])))

            monkeypatch.setattr(widget, "send", send)
            await page.expose_function("toWidget", lambda event: widget._rfb_handle_msg(widget, event, []))
            await page.expose_function("setTrait", lambda name, value: setattr(widget, name, value))
            await page.add_style_tag(content=Widget._css)
            names = ("css_width", "css_height", "resizable", "has_titlebar", "title", "cursor")
            await page.evaluate(MODEL, [Widget._esm, {name: getattr(widget, name) for name in names}])

            async def shown(kind, after):
                for _ in range(200):
                    if any(mimetype == kind for mimetype, _ in sent[after:]):
                        return len(sent)
                    await asyncio.sleep(0.02)
                raise AssertionError(f"no {kind}: {[mimetype for mimetype, _ in sent]}")

            n = await shown("image/png", 0)
            assert widget.get_frame().shape == (198, 318, 4), "within its frame of a pixel"
            first = await page.screenshot()
            azimuth_rad, distance = widget.orbit.azimuth_rad, widget.orbit.distance
            await page.mouse.move(100, 100)
            await page.mouse.down()
            for x in range(110, 190, 10):
                await page.mouse.move(x, 100)
                await asyncio.sleep(0.02)
            n = await shown("image/jpeg", n)
            await page.mouse.up()
            n = await shown("image/png", n)
            assert widget.orbit.azimuth_rad < azimuth_rad - 0.5
            await page.mouse.wheel(0, -200)
            n = await shown("image/png", n)
            assert widget.orbit.distance < distance
            await page.keyboard.press("ArrowUp")
            await shown("image/png", n)
            await asyncio.gather(*tasks)
            await page.wait_for_timeout(100)
            assert await page.screenshot() != first
            await browser.close()
        assert not widget._output_context.outputs

    with open_scene(tmp_path / "s", width=320, height=200, settings=settings) as view:
        widget = Widget(view)
        asyncio.run(act(widget))
        widget.close()
