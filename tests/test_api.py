"""The Python API: the same bits as ``splatpipe run``, settings that change, one-line errors, and what it imports."""

import subprocess
import sys
import threading

import numpy as np
import pytest
from PIL import Image
from splatpipe.cluster.api import open_config, open_scene
from splatpipe.cluster.job import Job
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.errors import ConfigError, InputError, SplatpipeError, StoreError
from splatpipe.shared.synth import CityScan

WIDTH, HEIGHT = 120, 80
CPU = {"render.rasterizer": "cpu"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("api") / "city.scene"
    build_scene([CityScan(n_points=30_000)], path, settings=BuildSettings(points_per_cell=500))
    return path


def opened(scene, **settings):
    return open_scene(scene, width=WIDTH, height=HEIGHT, settings=CPU | settings)


@pytest.fixture(scope="module")
def view(scene):
    with opened(scene) as view:
        yield view


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {
            "render.supersampling": 3,
            "render.edl_strength": 0.5,
            "render.colour": "elevation",
            "render.point_size_px": 2,
        },
        {"filter.classes": [6], "sampling.pixel_threshold": 4, "camera.path": "orbit", "camera.start_deg": 40.0},
    ],
    ids=["plain", "lit", "filtered"],
)
def test_the_bits_are_those_of_a_run(scene, tmp_path, settings):
    settings = CPU | {
        "camera.width": WIDTH,
        "camera.height": HEIGHT,
        "output.frames": 5,
        "output.depth": True,
        **settings,
    }
    (tmp_path / "run.toml").write_text(f'[scene]\npath = "{scene}"\n[pipeline]\ntopology = "single"\n')
    command = [sys.executable, "-m", "splatpipe.cluster", "run", "run.toml"]
    for key, value in settings.items():
        command += ["--set", f"{key}={str(value).lower() if isinstance(value, bool) else value}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    with open_config(tmp_path / "run.toml", settings) as view:
        for number in (0, 3):
            expected = np.asarray(Image.open(tmp_path / "frames" / f"frame_000{number}.png"))
            depth = np.asarray(Image.open(tmp_path / "frames" / f"depth_000{number}.tiff"))
            assert len(np.unique(expected.reshape(-1, 3), axis=0)) > 20
            image = view.render(view.camera(number))
            assert image.shape == (HEIGHT, WIDTH, 4)
            assert image.dtype == np.uint8
            assert np.array_equal(image[..., :3], expected)
            picture = view.picture(view.camera(number), ("rgba", "depth"))
            assert np.array_equal(picture.rgba, image)
            assert np.array_equal(picture.depth, depth)
            assert picture.normals is None
        orbit = view.orbit(azimuth_deg=settings.get("camera.start_deg", 0.0))
        assert np.array_equal(view.render(orbit), view.render(view.camera(0)))
        assert np.array_equal(view.render(), view.render(view.camera(0)))


def test_cameras_see_what_they_look_at(view):
    middle = (view.lower + view.upper) / 2
    eye = middle + np.array([30, -200, 90])
    for camera in (view.look_at(eye, middle), view.orbit(30, 40, target=middle, distance=250, fov_deg=30)):
        x, y, _, w = camera.clip_from_world @ (*middle, 1)
        assert (x / w, y / w) == pytest.approx((0, 0), abs=1e-9)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert camera.eye == pytest.approx(middle + 250 * (camera.eye - middle) / np.linalg.norm(camera.eye - middle))
    above = view.orbit(elevation_deg=90)
    assert above.clip_from_world[3, :3] == pytest.approx(-view.up, abs=1e-12)
    assert view.render(view.look_at(eye, middle, width=33, height=21)).shape == (21, 33, 4)


def test_pictures_of_several_sizes_and_layers_stay_the_same(view):
    first = view.render()
    sizes = [(40, 30), (50, 20), (64, 64), (30, 70)]
    small = [view.picture(view.orbit(width=w, height=h), ("depth", "normals")) for w, h in sizes]
    assert [picture.depth.shape for picture in small] == [(h, w) for w, h in sizes]
    assert [picture.normals.shape for picture in small] == [(h, w, 4) for w, h in sizes]
    assert all(picture.rgba is None for picture in small)
    assert len(view._stages) <= 3
    again = view.render()
    assert np.array_equal(first, again)
    assert first is not again


def test_set_is_opening_with_other_settings(scene):
    changes = [
        {"render.colour": "classification"},
        {"render.colour": "#ff8000", "render.background": "#000000"},
        {"filter.classes": [2, 6]},
        {"filter.classes": [], "filter.boxes": [{"lower": [0, 0, -9], "upper": [100, 100, 99], "keep": "inside"}]},
        {"filter.boxes": [], "render.point_size_px": 3, "render.supersampling": 2},
        {"render.point_size_adaptive": True, "render.colour": "elevation", "render.colour_range": [0.0, 30.0]},
        {"render.positions": "compact", "render.point_size_adaptive": False, "sampling.pixel_threshold": 0},
        {"camera.width": 50, "camera.fov_deg": 60.0, "render.edl_strength": 1.0},
    ]
    settings = {}
    with opened(scene) as view:
        for change in changes:
            before = view.render()
            settings |= change
            view.set(change)
            with opened(scene, **settings) as fresh:
                image = view.render()
                assert np.array_equal(image, fresh.render()), change
                assert image.shape != before.shape or (image != before).any(), change


def test_points_are_read_again_only_where_they_must_be(scene, monkeypatch):
    read = []
    original = Job.load_any
    monkeypatch.setattr(Job, "load_any", lambda self, *a, **k: read.append(1) or original(self, *a, **k))
    with opened(scene) as view:
        for change in ({"render.point_size_px": 2}, {"render.colour": "level"}, {"filter.classes": [6]}):
            view.set(change)
            view.render()
        assert len(read) == 1
        view.set({"render.point_size_adaptive": True})
        assert len(read) == 2


def test_a_change_that_is_refused_changes_nothing(scene):
    with opened(scene) as view:
        before = view.render()
        for settings, message in (
            ({"render.point_size_px": 3, "render.colour": "heat"}, r"render\.colour = 'heat', expected one of"),
            ({"render.colur": "rgb"}, "unknown key render.colur, did you mean render.colour"),
            ({"colour": "rgb"}, "found key 'colour', expected section.key"),
            ({"scene.path": "x"}, "scene.path cannot be changed"),
            ({"layers": []}, "layers cannot be changed"),
            ({"camera.view": "stereo"}, "one view is drawn at a time"),
        ):
            with pytest.raises(ConfigError, match=message) as told:
                view.set(settings)
            assert "\n" not in str(told.value)
        assert np.array_equal(view.render(), before)


def test_errors_say_in_a_line_what_was_found(scene, tmp_path):
    with pytest.raises(StoreError, match="not a scene"):
        open_scene(tmp_path)
    with pytest.raises(ConfigError, match=r"render\.point_size_px = 0"):
        opened(scene, **{"render.point_size_px": 0})
    with pytest.raises(ConfigError, match="cannot be read"):
        open_config(tmp_path / "none.toml")
    view = opened(scene)
    with pytest.raises(InputError, match="found 'colour', expected some of rgba"):
        view.picture(layers=("colour",))
    with pytest.raises(InputError, match="eye and target coincide"):
        view.look_at((1, 2, 3), (1, 2, 3))
    with pytest.raises(InputError, match="found picture 120"):
        view.camera(120)
    with pytest.raises(SplatpipeError):
        view.render(view.orbit(width=1 << 17))
    view.close()
    view.close()
    for call in (view.render, lambda: view.set({}), lambda: view.pick(1, 1)):
        with pytest.raises(InputError, match="has been closed"):
            call()


def test_what_is_picked_is_in_the_picture(view):
    picture = view.picture(layers=("rgba", "depth"))
    rows, columns = np.nonzero(picture.depth)
    same = 0
    for i in range(0, len(rows), len(rows) // 40):
        found = view.pick(columns[i], rows[i])
        same += abs(found["attributes"]["depth"] - picture.depth[rows[i], columns[i]]) < 1e-3
        assert (
            (np.array(found["position"]) >= view.lower - 1e-6) & (np.array(found["position"]) <= view.upper + 1e-6)
        ).all()
        assert set(found["attributes"]) == {"index", "depth", *view.info.attributes}
    assert same >= 39
    assert view.pick(0, 0) is None


@pytest.mark.gl
@pytest.mark.skipif(not gl_available()[0], reason="no OpenGL")
def test_with_opengl_points_are_on_the_device_once(scene):
    with opened(scene, **{"render.rasterizer": "gl", "render.colour": "elevation"}) as view:
        assert not view.keeps_sizes
        first = view.render()
        small = view.render(view.orbit(width=60, height=40))
        assert len(view._stages) == 1
        assert (np.ptp(small.reshape(-1, 4), axis=0) > 0).any()
        assert np.array_equal(view.render(), first)
        with opened(scene, **{"render.colour": "elevation"}) as other:
            assert (view.render() != other.render()).any(axis=-1).mean() < 0.05


@pytest.mark.parametrize(
    ("build", "settings"),
    [
        ({"splats": True}, {"render.style": "splats"}),
        ({"positions": "groups"}, {"render.positions": "coded"}),
        ({"positions": "eci"}, {"render.point_size_px": 2}),
        ({}, {"memory.residency": "paged", "memory.complete": True}),
    ],
    ids=["splats", "groups", "coded", "paged"],
)
def test_other_forms_of_points_are_drawn_and_picked(tmp_path, build, settings):
    built = BuildSettings(points_per_cell=500, **build)
    build_scene([CityScan(n_points=8_000)], tmp_path / "s", settings=built)
    with opened(tmp_path / "s", **settings) as view:
        picture = view.picture(layers=("rgba", "depth"))
        rows, columns = np.nonzero(picture.depth)
        assert len(rows) > 500
        near = 0
        for i in range(0, len(rows), len(rows) // 20):
            found = view.pick(columns[i], rows[i])
            near += found is not None and abs(found["attributes"]["depth"] - picture.depth[rows[i], columns[i]]) < 2
        assert near >= 17
        assert (view.render(view.orbit(90, 50, width=50, height=50)) != picture.rgba[0, 0]).any()
        view.set({"render.colour": "elevation"})
        assert (view.render() != picture.rgba).any()


def test_no_thread_is_left(scene):
    before = set(threading.enumerate())
    with opened(scene, **{"render.edl_strength": 0.4}) as view:
        view.render()
        view.render(view.orbit(width=30, height=30))
    assert set(threading.enumerate()) == before


def test_opening_and_drawing_imports_no_mpi_socket_or_web_library(scene):
    script = (
        "import sys\n"
        "from splatpipe.cluster.api import open_scene\n"
        "print([name for name in ('numba', 'numpy', 'pydantic') if name in sys.modules])\n"
        f"with open_scene({str(scene)!r}, width=40, height=30, settings={CPU}) as view:\n"
        "    view.render()\n"
        "heavy = ('mpi4py', 'zmq', 'aiohttp', 'moderngl', 'jupyter_rfb', 'IPython', 'matplotlib', 'laspy', 'av')\n"
        "print([name for name in heavy if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:2] == ["[]", "[]"]
