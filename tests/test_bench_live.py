"""scripts/bench_live against a real run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.synth import CityScan

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "bench_live"


def test_a_drag_is_timed(tmp_path):
    pytest.importorskip("zmq", reason="pyzmq is missing: splatpipe[live]")
    pytest.importorskip("aiohttp", reason="aiohttp is missing: splatpipe[live]")
    build_scene([CityScan(n_points=20_000)], tmp_path / "city.scene", settings=BuildSettings())
    config = tmp_path / "live.toml"
    config.write_text('[scene]\npath = "city.scene"\n[camera]\nwidth = 160\nheight = 90\n')
    command = [
        sys.executable,
        SCRIPT,
        config,
        "--seconds",
        "0.6",
        "--settle",
        "0.3",
        "--set",
        "pipeline.topology=single",
    ]
    command += ["--set", "render.rasterizer=cpu"]
    done = subprocess.run([*command, "--json", tmp_path / "found.json"], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "left behind: nothing" in done.stdout
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["pictures"] > 0
    assert 0 < found["latency_ms"]["median"] <= found["latency_ms"]["p95"]
    assert {"drawing", "encoding", "decode"} <= set(found["parts_ms"])
    assert sum(of["median"] for of in found["parts_ms"].values()) < 2 * found["latency_ms"]["max"]
    assert found["still"]["encoding"] == "png"
    assert found["still"]["size"] == [160, 90]
    assert found["memory_bytes"]["hub"]["last"] > 1e6
