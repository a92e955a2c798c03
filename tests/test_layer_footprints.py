"""GeoJSON and CityJSON → polygons: outlines, heights, values, metres; and what is refused in one line."""

import json
import math

import numpy as np
import pytest
from splatpipe.shared.errors import InputError
from splatpipe.shared.layers.layer_store import open_layer
from splatpipe.shared.layers.readers import json_file
from splatpipe.shared.layers.readers.footprints import HeightRules, bounding_boxes, number_of, polygons_from_file
from typer.testing import CliRunner

SQUARE = [[0, 0], [1000, 0], [1000, 1000], [0, 1000], [0, 0]]
DEGREES = [[4.0, 52.0], [4.01, 52.0], [4.01, 52.01], [4.0, 52.01], [4.0, 52.0]]


def moved(ring, dx):
    return [[p[0] + dx, *p[1:]] for p in ring]


def feature(geometry, **properties):
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def collection(*features, **more):
    return {"type": "FeatureCollection", "features": list(features), **more}


def written(tmp_path, content):
    path = tmp_path / "in.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def read(tmp_path, content, degrees=None, types=None, **rules):
    return polygons_from_file(written(tmp_path, content), HeightRules(**rules), degrees=degrees, types=types)


def by_value(layer):
    """Lower and upper corners, and values, in the order of these."""
    order = np.argsort(layer.objects["value"])
    return *(corner[order] for corner in layer.bounds), layer.objects["value"][order]


def test_features_of_each_geometry_become_objects_and_others_are_counted(tmp_path):
    made = read(
        tmp_path,
        collection(
            feature(polygon(SQUARE), n=1),
            feature({"type": "MultiPolygon", "coordinates": [[moved(SQUARE, 5000)], [moved(SQUARE, 7000)]]}, n=2),
            feature({"type": "GeometryCollection", "geometries": [polygon(moved(SQUARE, 9000))]}, n=3),
            feature({"type": "Point", "coordinates": [1, 2]}, n=4),
            feature(None, n=5),
            feature(polygon([[0, 0], [1, 1], [0, 0]]), n=6),
            {"type": "Feature", "geometry": None, "properties": None},
        ),
        value_property="n",
        height=7.0,
        base=2.0,
    )
    lower, upper, value = by_value(made.layer)
    assert value.tolist() == [1, 2, 3]
    assert lower[:, 0].tolist() == [0, 5000, 9000]
    assert upper[:, 0].tolist() == [1000, 8000, 10_000]
    assert (lower[:, 2] == 2).all()
    assert (upper[:, 2] == 9).all()
    assert made.notes == [
        "heights: none in 4 of 4 objects, drawn 7 high",
        "left out: 2 no geometry, 1 Point, 1 without area",
    ]


@pytest.mark.parametrize("content", [polygon(SQUARE), feature(polygon(SQUARE)), "\ufeff" + json.dumps(polygon(SQUARE))])
def test_a_file_may_be_a_feature_or_a_geometry_and_begin_with_a_mark(tmp_path, content):
    assert len(read(tmp_path, content).layer) == 1


@pytest.mark.parametrize(
    ("properties", "lower", "upper"),
    [
        ({"height": 12}, 0, 12),
        ({"Height": "12.5 m"}, 0, 12.5),
        ({"height": "about 12", "measuredHeight": 4}, 0, 4),
        ({"height": None, "building:levels": "3"}, 0, 9),
        ({"height": 12, "building:levels": 9, "min_height": 5}, 5, 12),
        ({"height": True}, 0, 10),
        ({}, 0, 10),
    ],
)
def test_heights_come_from_properties_that_are_known(tmp_path, properties, lower, upper):
    low, high, value = by_value(read(tmp_path, collection(feature(polygon(SQUARE), **properties))).layer)
    assert (low[0, 2], high[0, 2], value[0]) == (lower, upper, upper - lower)


def test_heights_and_values_come_from_the_properties_named(tmp_path):
    features = [
        feature(polygon(moved(SQUARE, 2000 * i)), worth=w, v=v) for i, (w, v) in enumerate([(5, 1), (None, 0), (7, 2)])
    ]
    made = read(
        tmp_path, collection(*features), height_property="worth", height_scale=2.0, value_property="v", height=3
    )
    assert by_value(made.layer)[1][:, 2].tolist() == [3, 10, 14]
    assert made.notes == ["heights from worth (2)", "heights: none in 1 of 3 objects, drawn 3 high"]
    with pytest.raises(
        InputError, match=r"property size: found in no object as a number, expected one of those: worth, v"
    ):
        read(tmp_path, collection(*features), height_property="size")
    with pytest.raises(InputError, match="property colour: found in no object"):
        read(tmp_path, collection(*features), value_property="colour")


def test_values_that_are_missing_are_the_least_and_that_is_said(tmp_path):
    features = [feature(polygon(moved(SQUARE, 2000 * i)), v=v) for i, v in enumerate([4, None, 9])]
    made = read(tmp_path, collection(*features), value_property="v")
    assert sorted(made.layer.objects["value"].tolist()) == [4, 4, 9]
    assert "values: no number in 1 of 3 objects, taken as 4, the least" in made.notes


def test_positions_with_heights_say_where_objects_begin(tmp_path):
    ring = [[*p, 30.0 + p[0] / 1000] for p in SQUARE]
    lower, upper, _ = by_value(read(tmp_path, polygon(ring), base=1.0).layer)
    assert (lower[0, 2], upper[0, 2]) == (31, 41)


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("12", 12),
        (" -3.5m ", -3.5),
        ("1e3", None),
        ("", None),
        ("NaN", None),
        (math.inf, None),
        (10**400, None),
        ([], None),
    ],
)
def test_numbers_of_properties(text, number):
    assert number_of(text) == number


def test_degrees_become_metres_around_the_middle(tmp_path):
    made = read(tmp_path, polygon(DEGREES))
    lower, upper = (corner[0] for corner in made.layer.bounds)
    # lengths of a degree on the ellipsoid at 52.005°, from the series that geodesists use
    phi = math.radians(52.005)
    along = 111_132.92 - 559.82 * math.cos(2 * phi) + 1.175 * math.cos(4 * phi)
    across = 111_412.84 * math.cos(phi) - 93.5 * math.cos(3 * phi) + 0.118 * math.cos(5 * phi)
    np.testing.assert_allclose(upper[:2] - lower[:2], [0.01 * across, 0.01 * along], rtol=1e-5)
    np.testing.assert_allclose((lower + upper)[:2], 0, atol=1e-3)
    assert made.layer.parameters["middle_deg"] == pytest.approx([4.005, 52.005])
    assert "coordinates: degrees" in made.notes[-1]


@pytest.mark.parametrize(
    ("ring", "crs", "degrees", "is_turned"),
    [
        (DEGREES, None, None, True),
        (DEGREES, "urn:ogc:def:crs:OGC:1.3:CRS84", None, True),
        (DEGREES, "urn:ogc:def:crs:EPSG::4326", None, True),
        (DEGREES, "urn:ogc:def:crs:EPSG::28992", None, False),
        (DEGREES, None, False, False),
        (DEGREES, "urn:ogc:def:crs:EPSG::28992", True, True),
        (SQUARE, None, None, False),
        (SQUARE, "urn:ogc:def:crs:EPSG::4326", None, False),
    ],
)
def test_which_coordinates_are_degrees(tmp_path, ring, crs, degrees, is_turned):
    more = {} if crs is None else {"crs": {"type": "name", "properties": {"name": crs}}}
    layer = read(tmp_path, collection(feature(polygon(ring)), **more), degrees=degrees).layer
    assert ("middle_deg" in layer.parameters) == is_turned
    width = (layer.bounds[1] - layer.bounds[0])[0, 0]
    assert width == pytest.approx((686.7 if is_turned else 0.01) if ring is DEGREES else 1000, rel=1e-3)


def test_metres_are_no_degrees(tmp_path):
    with pytest.raises(InputError, match=r"found the position \[1000.0, 0.0\], expected degrees; try --no-degrees"):
        read(tmp_path, polygon(SQUARE), degrees=True)


def test_outlines_across_the_antimeridian_stay_whole(tmp_path):
    rings = [[179.99, 0], [-179.99, 0], [-179.99, 0.01], [179.99, 0.01]], [[179.9, 0], [179.91, 0], [179.9, 0.01]]
    layer = read(tmp_path, collection(*(feature(polygon(ring)) for ring in rings))).layer
    lower, upper = layer.bounds
    assert sorted((upper - lower)[:, 0]) == pytest.approx([1113.2, 2226.4], rel=1e-3)


def test_boxes_around_polygons(tmp_path):
    layer = read(tmp_path, collection(feature(polygon(SQUARE[:3])), feature(polygon(moved(SQUARE, 5000))))).layer
    boxes = bounding_boxes(layer)
    assert boxes.kind == "cuboids"
    np.testing.assert_array_equal(boxes.bounds, layer.bounds)


def city(*, semantics=None, lod="1", faces=None, kind="Solid", attributes=None, more=None):
    """A cube of 20 m in thousandths, as a solid."""
    vertices = [[x, y, z] for z in (0, 20_000) for x, y in ((0, 0), (20_000, 0), (20_000, 20_000), (0, 20_000))]
    faces = faces or [[3, 2, 1, 0], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    boundaries = [[face] for face in faces]
    geometry = {"type": kind, "lod": lod, "boundaries": [boundaries] if kind == "Solid" else boundaries}
    if semantics is not None:
        geometry["semantics"] = semantics
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001] * 3, "translate": [85_000.0, 446_000.0, -2.0]},
        "CityObjects": {
            "a": {"type": "Building", "attributes": attributes or {}, "geometry": [geometry]},
            "road": {"type": "Road", "geometry": [geometry]},
            **(more or {}),
        },
        "vertices": vertices,
    }


@pytest.mark.parametrize(
    "content",
    [
        city(),
        city(faces=[[4, 5, 6], [4, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]),  # no floor
        city(faces=[[0, 1, 2, 3], [4, 7, 6, 5]], kind="MultiSurface"),
        city(
            semantics={
                "surfaces": [{"type": "GroundSurface"}, {"type": "RoofSurface"}],
                "values": [[0, 1, None, None, 1, 7]],
            },
        ),
        city(semantics={"surfaces": "?", "values": [[0, [], {}]]}),
    ],
)
def test_solids_stand_on_their_outline(tmp_path, content):
    made = read(tmp_path, content)
    lower, upper, value = by_value(made.layer)
    np.testing.assert_allclose(lower, [[85_000, 446_000, -2]])
    np.testing.assert_allclose(upper, [[85_020, 446_020, 18]])
    assert value.tolist() == [20]
    assert made.layer.elements["side"].sum() == 4
    assert made.notes == ["heights from geometry (1)", "left out: 1 Road"]


def test_surfaces_that_overlap_are_prisms_of_their_own(tmp_path):
    roofs = city(faces=[[4, 5, 6, 7], [0, 1, 2]], kind="MultiSurface")  # both face up
    layer = read(tmp_path, roofs).layer
    assert len(layer) == 1
    assert layer.elements["side"].sum() == 7
    np.testing.assert_allclose(layer.bounds[1] - layer.bounds[0], [[20, 20, 20]])


def test_flat_footprints_rise_by_their_property(tmp_path):
    made = read(tmp_path, city(lod="0", kind="MultiSurface", faces=[[0, 1, 2, 3]], attributes={"measuredHeight": 6}))
    lower, upper, _ = by_value(made.layer)
    assert (lower[0, 2], upper[0, 2]) == (-2, 4)


def test_parts_are_taken_for_the_whole_and_the_lowest_level_that_rises(tmp_path):
    content = city(lod="2.2")
    (solid,) = content["CityObjects"]["a"]["geometry"]
    flat = {"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2, 3]]]}
    half = {"type": "Solid", "lod": 1, "boundaries": [[[[4, 5, 6]], [[2, 1, 0]]]]}
    part = {"type": "BuildingPart", "parents": ["a"], "geometry": [solid, flat, half]}
    content["CityObjects"]["a"] |= {"children": ["b"], "geometry": [flat]}
    layer = read(tmp_path, content | {"CityObjects": content["CityObjects"] | {"b": part}}).layer
    assert len(layer) == 1
    assert layer.elements["side"].sum() == 3
    roads = read(tmp_path, content, types=["Road"]).layer
    assert roads.elements["side"].sum() == 4


def broken(change):
    content = city()
    change(content)
    return content


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", "not valid JSON"),
        ("{", "not valid JSON"),
        ("[1, 2]", "found a list of 2, expected an object"),
        ('{"type": "FeatureCollection", "features": [NaN]}', "not valid JSON: NaN is no number"),
        ('{"a": ' + "[" * 200_000, "nested too deep"),
        ("{}", "type: found 'None', expected one of CityJSON, FeatureCollection"),
        ('{"type": "Topology\\u001b[2J"}', r"type: found 'Topology\\x1b\[2J', expected"),
        ({"type": ["CityJSON"]}, "type: found"),
        ({"type": "FeatureCollection"}, "features: found null, expected a list"),
        (collection(), "found no polygon, expected at least one"),
        (collection(feature({"type": "Point"})), "found no polygon: 1 Point, expected at least one"),
        (collection(3), r"features\[0\]: found 3, expected a feature"),
        (collection(feature(polygon(SQUARE)) | {"properties": [1]}), r"features\[0\].properties: found a list of 1"),
        (collection(feature([])), r"features\[0\].geometry: found a list of 0, expected a geometry"),
        (collection(feature({"type": "Polygone"})), r'geometry: found "Polygone", expected a geometry'),
        (collection(feature({"type": "Polygon"})), "coordinates: found null, expected a list of rings"),
        (collection(feature(polygon(3))), r"coordinates\[0\]: found 3, expected a list of positions"),
        (
            collection(feature(polygon([[0, 0], [1]]))),
            r"coordinates\[0\]\[1\]: found a list of 1, expected 2 to 4 finite",
        ),
        (collection(feature(polygon([[0, 0], ["1", 2]]))), r'coordinates\[0\]\[1\]: found "1", expected 2 to 4 finite'),
        (collection(feature(polygon([[0, 0], [True, 2]]))), r"coordinates\[0\]\[1\]: found true"),
        (collection(feature(polygon([[0, 0], [0, 10**400]]))), r"coordinates\[0\]\[1\]: found a huge number"),
        ('{"type": "Polygon", "coordinates": [[[0, 1e999]]]}', r"coordinates\[0\]\[0\]: found Infinity"),
        (polygon([[0, 0], [1, 1], [2, 2]]), "found no outline with an area"),
        (polygon([]), "found no outline, expected at least one"),
        (broken(lambda c: c.update(CityObjects=[])), "CityObjects: found a list of 0"),
        (broken(lambda c: c["CityObjects"].pop("a")), "found no polygon: 1 Road"),
        (broken(lambda c: c["CityObjects"].update(a=1)), "CityObjects.'a': found 1, expected an object"),
        (
            broken(lambda c: c["CityObjects"]["a"].update(geometry={})),
            "geometry: found an object of 0, expected a list",
        ),
        (broken(lambda c: c["CityObjects"]["a"].update(geometry=[1])), r"geometry\[0\]: found 1, expected an object"),
        (broken(lambda c: c["CityObjects"]["a"].update(attributes=1)), "attributes: found 1, expected an object"),
        (city(faces=[[0, 1, 8]]), "boundaries: found 8, expected the number of a vertex, 0 to 7"),
        (city(faces=[[0, 1, -1]]), "boundaries: found -1"),
        (city(faces=[[0, 1, 1.0]]), "boundaries: found 1.0"),
        (city(faces=[3]), "boundaries: found 3, expected a ring"),
        (city() | {"vertices": [[0, 0]]}, r"vertices\[0\]: found a list of 2, expected 3 finite numbers"),
        (city() | {"transform": []}, "transform: found a list of 0"),
        (city() | {"transform": {"scale": [1, 1]}}, r"transform.scale\[0\]: found a list of 2"),
        (city() | {"transform": {"scale": [1e29] * 3, "translate": [0] * 3}}, "found vertices beyond 1e"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, content, text):
    with pytest.raises(InputError, match=text) as error:
        read(tmp_path, content)
    assert "\n" not in str(error.value)
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 400


def places(content, here=()):
    """The keys and indices that lead to each value."""
    yield here
    for key in content if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ():
        yield from places(content[key], (*here, key))


ODD = [None, True, -1, 1.5, 1e300, -1e29, 10**40, "", "12", [], {}, [[]], [1, 2], {"type": "Polygon"}, "MultiSolid"]


@pytest.mark.parametrize("seed", range(4))
def test_whatever_is_changed_there_is_a_layer_or_one_line(tmp_path, seed):
    rng = np.random.default_rng(seed)
    semantics = {"surfaces": [{"type": "GroundSurface"}], "values": [[0, None, 0, None, None, None]]}
    parts = {"type": "MultiPolygon", "coordinates": [[DEGREES]]}
    originals = [
        city(semantics=semantics),
        city(kind="MultiSurface", attributes={"height": 3}),
        collection(feature(polygon(SQUARE, moved(SQUARE, 300)), height=3), feature(parts, v=2)),
    ]
    made, said = 0, []
    for _ in range(150):
        content = {"": json.loads(json.dumps(originals[rng.integers(3)]))}
        for _ in range(rng.integers(1, 4)):
            *way, last = list(places(content))[1:][rng.integers(len(list(places(content))) - 1)]
            holder = content
            for key in way:
                holder = holder[key]
            holder[last] = ODD[rng.integers(len(ODD))]
        try:
            made += len(read(tmp_path, content[""]).layer) > 0
        except InputError as error:
            said.append(str(error))
    assert 0 < made < 150
    assert all(map(str.isprintable, said))


def test_large_files_are_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(json_file, "MAX_BYTES", 100)
    with pytest.raises(InputError, match=r"found 1.. bytes, expected at most 100"):
        read(tmp_path, polygon(SQUARE, SQUARE))
    with pytest.raises(InputError, match="cannot be read: No such file"):
        json_file.read_json(tmp_path / "none.json")


def test_from_the_command_line(tmp_path):
    from splatpipe.cluster.layers import layer_app

    source, out = written(tmp_path, collection(feature(polygon(SQUARE), worth=4))), tmp_path / "x.layer"
    command = [
        "polygons",
        str(source),
        "-o",
        str(out),
        "--height-property",
        "worth",
        "--height-scale",
        "3",
        "--base",
        "-1",
    ]
    done = CliRunner().invoke(layer_app, command)
    assert done.exit_code == 0, done.output
    assert "1 polygons" in done.output
    assert "heights from worth (1)" in done.output
    lower, upper = open_layer(out).bounds
    assert (lower[0, 2], upper[0, 2]) == (-1, 11)
    assert isinstance(CliRunner().invoke(layer_app, command).exception, InputError)  # it is there already
    done = CliRunner().invoke(layer_app, [*command, "--boxes", "--overwrite"])
    assert done.exit_code == 0, done.output
    assert open_layer(out).kind == "cuboids"
    done = CliRunner().invoke(layer_app, ["polygons", str(source), "-o", str(out), "--height", "nan"])
    assert "--height: found nan" in str(done.exception)
