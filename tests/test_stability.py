"""The stability suite passes: one test a case; and the suite says so when it does not."""

import json
import sys

import numpy as np
import pytest
from splatpipe.cluster.stability import suite
from splatpipe.cluster.stability.suite import all_cases
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.raster import reference
from splatpipe.shared.errors import InputError
from splatpipe.shared.messages import VisibilityBits
from splatpipe.shared.stability import eigenvalues
from splatpipe.shared.stability.case import FAILED, OUT_OF_REACH, PASSED, case, cases, expect, out_of_reach, run


@pytest.mark.parametrize("case", all_cases(), ids=lambda case: case.name)
def test_case(case):
    outcome = run(case)
    if outcome.verdict == OUT_OF_REACH:
        pytest.skip(outcome.reason)
    assert outcome.verdict == PASSED, f"{outcome.value} {case.unit}, bound {case.bound}: {outcome.reason}"


def named(name):
    return next(c for c in all_cases() if c.name == name)


def outcome_of(function, bound=1.0):
    return run(case("a/case", bound=bound, unit="px")(function))


def failing():
    raise ZeroDivisionError("division by zero")


def unmeasured():
    expect([], "there are points")


def test_a_value_that_is_no_number_an_exception_and_a_broken_premise_are_failures():
    assert outcome_of(lambda: 1.0).verdict == PASSED
    assert outcome_of(lambda: 1.0001).verdict == FAILED
    for value in ("nan", "inf", "-inf"):
        outcome = outcome_of(lambda value=value: float(value), bound=float("inf"))
        assert (outcome.verdict, outcome.value) == (FAILED, None)
        assert value in outcome.reason
    assert outcome_of(failing).reason == "ZeroDivisionError: division by zero"
    assert "there are points" in outcome_of(unmeasured).reason
    assert run(out_of_reach("a/case", "something", "no such thing yet")).reason == "no such thing yet"


def test_a_family_has_a_case_for_each_parameter_and_says_what_its_function_says():
    def twice(x):
        """Twice
        the number.
        """
        return 2 * x

    family = cases("a/family", bounds={1.0: 2.0, 2e6: 3.0}, unit="")(twice)
    assert [(c.name, c.what, run(c).verdict) for c in family] == [
        ("a/family 1", "Twice the number.", PASSED),
        ("a/family 2e+06", "Twice the number.", FAILED),
    ]


def test_names_are_unique_and_say_something():
    names = [c.name for c in all_cases()]
    assert len(set(names)) == len(names) > 100
    assert all(c.what and "/" in c.name for c in all_cases())


def test_cases_that_need_50_digits_are_out_of_reach_without_mpmath(monkeypatch):
    monkeypatch.setitem(sys.modules, "mpmath", None)
    outcome = run(named("eigen/condition 100"))
    assert (outcome.verdict, outcome.value) == (OUT_OF_REACH, None)
    assert "splatpipe[stability]" in outcome.reason


def test_the_command_writes_what_it_measured_and_fails_when_a_case_does(tmp_path, monkeypatch, capsys):
    chosen = [case("a/good", bound=1.0, unit="px")(lambda: 0.5), case("a/bad", bound=1.0, unit="px")(lambda: 2.0)]
    monkeypatch.setattr(suite, "all_cases", lambda: chosen)
    assert suite.stability_command("good", None, None) == 0
    assert suite.stability_command("", tmp_path / "s.json", tmp_path / "s") == 1
    assert "1 passed, 1 failed, 0 out of reach" in capsys.readouterr().out
    record = json.loads((tmp_path / "s.json").read_text())["cases"]
    assert [(r["case"], r["value"], r["verdict"]) for r in record] == [("a/good", 0.5, PASSED), ("a/bad", 2.0, FAILED)]
    assert "a/bad" in (tmp_path / "s.md").read_text()
    with pytest.raises(InputError, match="no case of that name"):
        suite.stability_command("nothing", None, None)


def test_the_suite_notices_what_it_is_there_for(monkeypatch):
    def world_in_float32(camera, block_origin):
        m = camera.pixel_from_world.astype(np.float32)
        out = np.tile(m, (len(block_origin), 1, 1))
        out[:, :, 3] += block_origin.astype(np.float32) @ m[:, :3].T
        return out

    def plain_moments(moments, central):
        central[0] = moments[0]
        central[1:4] = moments[1:4] / moments[0]
        pairs = [(a, b) for a in range(3) for b in range(a, 3)]
        central[4:] = [moments[4 + i] - central[1 + a] * moments[1 + b] for i, (a, b) in enumerate(pairs)]

    def culls_a_little(self, camera):
        visible = see(self, camera).unpack()
        visible[-1] = 0
        return VisibilityBits.pack(camera.frame, visible)

    see = CullingNode.process
    monkeypatch.setattr(reference, "pixel_from_blocks", world_in_float32)
    monkeypatch.setattr(eigenvalues, "central_moments", plain_moments)
    assert run(named("projection/translation 6.4e+06")).verdict == FAILED
    assert run(named("eigen/far corner of a cell 2")).verdict == FAILED
    monkeypatch.undo()
    monkeypatch.setattr(CullingNode, "process", culls_a_little)
    assert run(named("cloud/drawn coplanar")).verdict == FAILED
