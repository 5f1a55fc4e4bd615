from clsas.engine.data.tables import Report, Table

NUMBERS = Table(("", "time (s)"), [("exact", "1.5"), ("-40 dB", "0.25")])

LINE = '<p style="white-space: pre-wrap">'


def test_numbers_stand_under_each_other():
    assert NUMBERS.lines() == ["        time (s)", " exact       1.5", "-40 dB      0.25"]


def test_words_begin_under_each_other():
    words = Table(("effect", "needed"), [("beam", "yes"), ("relief of grid", "-")], align="left")
    assert words.lines() == ["effect          needed", "beam            yes", "relief of grid  -"]


def test_a_report_is_one_text_and_one_page():
    report = Report(["Plan: < 1 s", NUMBERS, "Default  costs."])
    assert report.text().splitlines() == ["Plan: < 1 s", *NUMBERS.lines(), "Default  costs."]
    page = report.html()
    assert page.startswith(f"<div>{LINE}Plan: &lt; 1 s</p><table>")
    assert page.count("<tr>") == 3
    assert '<td style="text-align: right">0.25</td>' in page
    assert page.endswith(f"{LINE}Default  costs.</p></div>")


def test_a_report_may_have_no_table():
    assert Report(["Exact."]).text() == "Exact."
    assert Report(["Exact."]).html() == f"<div>{LINE}Exact.</p></div>"
