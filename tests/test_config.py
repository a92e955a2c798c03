"""Configuration: the shipped files are true, and what is wrong is named."""

import tomllib
from pathlib import Path

import pytest
from splatpipe.shared.config import RunConfig, load_config, parse_config
from splatpipe.shared.errors import ConfigError
from splatpipe.shared.layer_config import LayerSection

CONFIGS = Path(__file__).parent.parent / "configs"
RUNS = sorted([*CONFIGS.glob("*.toml"), *CONFIGS.glob("gallery/*.toml")])  # the other folders are of other commands
OPTIONAL = {"camera": {"center"}, "render": {"colour_range"}}


def test_defaults_file_states_every_key_with_its_default():
    stated = tomllib.loads((CONFIGS / "defaults.toml").read_text())
    actual = RunConfig().model_dump(mode="json")
    for section, keys in OPTIONAL.items():
        for key in keys:
            assert f"# {key} = " in (CONFIGS / "defaults.toml").read_text()
            assert actual[section].pop(key) is None
    assert actual.pop("layers") == []
    assert stated == actual


def test_defaults_file_states_every_key_of_a_layer():
    text = (CONFIGS / "defaults.toml").read_text()
    block = text[text.index("# [[layers]]") :].split("\n\n")[0]
    (stated,) = tomllib.loads("\n".join(line.removeprefix("# ") for line in block.splitlines()))["layers"]
    defaults = LayerSection(path="").model_dump(mode="json")
    assert stated.keys() == defaults.keys()
    for key, default in defaults.items():
        if isinstance(default, dict):
            assert stated[key].keys() == default.keys()
        assert default is None or stated[key] == default


@pytest.mark.parametrize("path", RUNS, ids=lambda p: p.name)
def test_every_shipped_file_loads_and_survives_a_round_trip(path):
    config = load_config(path)
    assert parse_config(config.model_dump(mode="json")) == config


def test_paths_in_a_file_are_relative_to_it_and_on_the_command_line_to_where_one_stands(tmp_path):
    (tmp_path / "run.toml").write_text('[scene]\npath = "a.scene"\n')
    assert load_config(tmp_path / "run.toml").scene.path == str(tmp_path / "a.scene")
    assert load_config(tmp_path / "run.toml", ["scene.path=b.scene"]).scene.path == "b.scene"


@pytest.mark.parametrize(
    ("text", "overrides", "said"),
    [
        (
            "[sampling]\npixel_treshold = 4",
            [],
            "unknown key sampling.pixel_treshold, did you mean sampling.pixel_threshold?",
        ),
        ("[samplng]\n", [], "unknown key samplng, did you mean sampling?"),
        ("[sampling]\npixel_threshold = -4", [], "sampling.pixel_threshold = -4, expected greater than or equal to 0"),
        ("[sampling]\npixel_threshold = nan", [], "sampling.pixel_threshold = nan"),
        ("[render]\nthreads = 'two'", [], "render.threads = 'two', expected a valid integer"),
        ("[render]\nedl_strength = 1e300", [], "render.edl_strength = 1e+300, expected less than or equal to 1000000"),
        ("[splats]\nradius_scale = 1e300", [], "splats.radius_scale = 1e+300, expected less than or equal to 1000000"),
        (
            "[render]\nrasterizer = 'vulkan'",
            [],
            "render.rasterizer = 'vulkan', expected 'auto', 'cpu', 'gl' or 'gl-points'",
        ),
        ("[camera]\nkeyframes = [{ time = 0.0, eye = [0, 0], target = [0, 0, 1] }]", [], "camera.keyframes.0.eye"),
        (
            "[camera]\nkeyframes = [{ tim = 0.0 }]",
            [],
            "unknown key camera.keyframes.tim, did you mean camera.keyframes.time?",
        ),
        ("camera = 3", [], "camera = 3, expected a table"),
        ("[camera", [], "not valid TOML"),
        ("", ["output.frames"], "--set output.frames: expected section.key=value"),
        ("", ["output.frames=0"], "output.frames = 0, expected greater than or equal to 1"),
        ("", ["output.png.x=1"], "output.png"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_with_file_key_found_and_expected(tmp_path, text, overrides, said):
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    message = str(caught.value)
    assert said in message
    assert "\n" not in message
    assert caught.value.exit_status == 2


def test_a_missing_file_and_bytes_that_are_no_text_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none.toml: cannot be read: No such file"):
        load_config(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_config(tmp_path / "binary.toml")


def test_bare_words_and_toml_values_can_be_set(tmp_path):
    (tmp_path / "run.toml").write_text("")
    config = load_config(tmp_path / "run.toml", ["render.colour=rgb", "camera.center=[1, 2, 3]", "output.mp4=true"])
    assert (config.render.colour, config.camera.center, config.output.mp4) == ("rgb", (1.0, 2.0, 3.0), True)
