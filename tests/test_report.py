"""Reports: both files say the same and stand alone."""

import re

from splatpipe.cluster.report import Report


def test_both_files_hold_texts_tables_and_plots(tmp_path):
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().plot([1, 2], [3, 4])
    report = Report("Title & <b>", "splatpipe nothing --at all")
    report.heading("Part one")
    report.text("A paragraph with 3 < 4.")
    report.table(["name", "n", "share", "odd"], [["a|b", 1234567, 0.123456, None], ["c", 2, 1e-9, True]], "What it is")
    report.plot(figure, "A line")
    html, markdown = report.write(tmp_path / "sub" / "r")
    page, text = html.read_text(), markdown.read_text()
    assert "<h1>Title &amp; &lt;b&gt;</h1>" in page
    assert "3 &lt; 4" in page
    assert page.count("data:image/png;base64,") == 1
    assert not re.search(r'(src|href)="(?!data:)', page), "nothing outside the file is needed"
    assert "## Part one" in text
    assert "| a\\|b | 1,234,567 |" in text
    assert "| c | 2 | 1e-09 | True |" in text
    assert "|---|---|---|---|" in text
    assert "![A line](r-1.png)" in text
    for said in ("1,234,567", "0.1235", "–", "splatpipe nothing --at all", "numpy"):
        assert said in page
        assert said in text
    assert (tmp_path / "sub" / "r-1.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in (tmp_path / "sub").iterdir()) == ["r-1.png", "r.html", "r.md"]
