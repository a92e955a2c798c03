"""Tables, a row an object: CSV and Parquet, and what is wrong with them."""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from splatpipe.shared.errors import InputError
from splatpipe.shared.layers.layer_store import open_layer
from splatpipe.shared.layers.readers.table import cuboids_from_table

COLUMNS = {"x": [1.0, 10.0], "y": [2, 2], "width": [3, 4], "depth": [4.0, 0.0], "height": [5, 9]}


def csv(path, columns=COLUMNS):
    rows = zip(*columns.values(), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def boxes(layer):
    lower, upper = layer.bounds
    return sorted(np.column_stack([lower, upper]).round(4).tolist())


def test_csv_and_parquet_give_the_same_boxes(tmp_path):
    parquet.write_table(pa.table(COLUMNS), tmp_path / "t.parquet")
    expected = [[-0.5, 0.0, 0.0, 2.5, 4.0, 5.0], [8.0, 2.0, 0.0, 12.0, 2.0, 9.0]]
    assert boxes(cuboids_from_table(csv(tmp_path / "t.csv"))) == expected
    assert boxes(cuboids_from_table(tmp_path / "t.parquet")) == expected


def test_base_and_value_are_taken_where_they_are(tmp_path):
    layer = cuboids_from_table(csv(tmp_path / "t.csv", COLUMNS | {"base": [100, 50], "value": [7, 8]}))
    assert boxes(layer)[0][2::3] == [100.0, 105.0]
    assert sorted(layer.objects["value"].tolist()) == [7, 8]
    assert sorted(cuboids_from_table(csv(tmp_path / "u.csv")).objects["value"].tolist()) == [5, 9]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"width": ["a", "b"]}, "column width"),
        ({"width": [-1, 2]}, "extent"),
        ({"height": ["nan", "1"]}, "height"),
        ({"x": ["", "1"]}, "center"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line_that_names_the_column(tmp_path, change, said):
    path = csv(tmp_path / "t.csv", COLUMNS | change)
    command = [sys.executable, "-m", "splatpipe.cluster", "layer", "cuboids", str(path), "-o", str(tmp_path / "l")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "l").exists()


def test_missing_columns_files_and_rows_are_named(tmp_path):
    with pytest.raises(InputError, match="column depth: not found"):
        cuboids_from_table(csv(tmp_path / "t.csv", {k: v for k, v in COLUMNS.items() if k != "depth"}))
    with pytest.raises(InputError, match="no row"):
        cuboids_from_table(csv(tmp_path / "u.csv", {k: [] for k in COLUMNS}))
    for name, content in (("gone.csv", None), ("bad.parquet", b"PAR1xx"), ("bad.csv", b"\xff\xfe\x00")):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            cuboids_from_table(tmp_path / name)


def test_the_command_makes_a_layer(tmp_path):
    path = csv(tmp_path / "towers.csv")
    command = [
        sys.executable,
        "-m",
        "splatpipe.cluster",
        "layer",
        "cuboids",
        str(path),
        "-o",
        str(tmp_path / "l.layer"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "2 cuboids" in done.stdout
    assert len(open_layer(tmp_path / "l.layer")) == 2
