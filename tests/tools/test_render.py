"""The renderer of the benchmarks' tables: fields, conditions, tables and goals."""

import pytest
from bench import slots
from bench.tables import render

ROW = {
    "name": "ours", "wall_s": {"writing": 1.25}, "bytes": 3 * 2**30, "share": 0.0213, "none": None, "reached": False,
    "each": [0.01, 0.02], "b_0.004": {"1": {"x": 2.0}}, "count": 12345, "zero": 0.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("template", "text"),
    [
        ("{name}: {wall_s.writing:.2f} s", "ours: 1.25 s"),
        ("{bytes:.1f GiB}, {bytes:.1f (GiB)}, {share:+.2f %}", "3.0 GiB, 3.0, +2.13 %"),
        ("{share:.3f °}, {share:.3f m}", "0.021°, 0.021 m"),
        ("{count:,} {count:digits} {share:digits}", "12,345 12,345 0.0213"),
        ("{none:.2f %}", "-"),
        ("{reached} {reached:bold}", "no **no**"),
        ("{each:.1f %}", "1.0 %, 2.0 %"),
        ("{b_0.004.1.x:g}", "2"),
        ("{missing or none or wall_s.writing:g} {missing or 'x':.1f}", "1.25 x"),
        ("a[[ of {count:,}]][[ of {missing}]][[ of {none}, {count}]][[ {zero:g}]]", "a of 12,345 0"),
    ],
)
def test_fields(template, text):
    assert render.fill(template, ROW) == text


@pytest.mark.parametrize("template", ["{missing}", "{wall_s.reading:.1f}", "{missing or absent}", "{name.first}"])
def test_what_is_not_recorded_is_an_error(template):
    with pytest.raises(KeyError):
        render.fill(template, ROW)


@pytest.mark.parametrize(
    ("condition", "held"),
    [
        ("share <= 0.03", True),
        ("share <= 0.03 and count > 1e5", False),
        ("name is 'ours' and reached is False", True),
        ("name not 'ours'", False),
        ("missing or name is 'ours'", True),
        ("zero < share", True),
        ("each <= 0.015", False),
        ("each <= 0.02", True),
        ("|off| <= 0.1", False),
        ("none <= 1", None),
    ],
)
def test_conditions(condition, held):
    assert render.holds(ROW | {"off": -0.2}, condition) is held


def test_a_table_with_a_row_that_failed():
    rows = [{"name": "a", "time": 1.0}, {"name": "b", "failed": "no\nmemory"}]
    assert render.lines(rows, "run = {name} | time = {time:.1f} |\n more = {name or '-'} {time:g}") == [
        "| run | time | more |", "|---|---|---|", "| a | 1.0 | a 1 |", "| b | failed: no memory | - |",
    ]  # fmt: skip
    with pytest.raises(KeyError):
        render.lines([{"name": "c"}], "run = {name} | time = {time:.1f}")


def test_rows_become_columns():
    """One row for each size, a column for each case, and a dash where a size lacks a case."""
    rows = [{"n": 1, "case": "off", "t": 1}, {"n": 1, "case": "on", "t": 2}, {"n": 2, "case": "on", "t": 3}, {"n": 3}]
    assert render.lines(rows, "size = {n} | *{case} [s] = {t}")[::2] == ["| size | off [s] | on [s] |", "| 1 | 1 | 2 |",
                                                                         "| 3 | - | - |"]  # fmt: skip
    assert render.lines([{"n": 3}], "size = {n} | *{case} = {t}") == ["| size |", "|---|", "| 3 |"]


@pytest.fixture
def declared(monkeypatch):
    """What a slot makes that is declared in a test."""
    monkeypatch.setattr(slots, "SLOTS", {})

    def make(declare, record, *words, **options):
        declare(**options)
        return slots.SLOTS["x"].make(record, *words)

    return make


def test_text_around_a_table_order_and_lists(declared):
    about = {"name": "x", "page": "p.md", "records": "r_*", "rows": "rows"}
    record = {"device": "a CPU", "versions": {"torch": "2"}, "rows": {"b": {"n": 2}, "a": {"n": 1}}}
    made = declared(
        render.table, record, columns="{key} = {key}", before="{source}", after="Done.", order=["n"], **about
    )
    assert made == ["a CPU; torch 2.", "", "| a |", "|---|", "| a |", "| b |", "", "Done."]
    assert declared(render.table, record, columns="- {key}: {n}", **about) == ["- b: 2", "- a: 1"]
    each = {"columns": "k = {key}", "each": True, "empty": "None yet."} | about
    block = ["| k |", "|---|", "| b |", "| a |"]
    assert declared(render.table, [{}, record, record], **each) == [*block, "", *block]
    assert declared(render.table, [{}], **each) == ["None yet."]


def test_values_take_the_words_of_their_slot(declared):
    about = {"name": "x", "records": "r_*", "template": "{$2.$1:.1f mm}"}
    assert declared(render.value, {"a": {"b": 0.002}}, "b", "a", **about) == "2.0 mm"
    assert slots.SLOTS["x"].words == 2


def test_goals():
    rows = [{"name": "a", "t": 1.5}, {"name": "b", "t": 3.0}, {"name": "c"}, {"name": "d", "failed": "x"}]
    rows.append({"name": "e", "t": None})
    goal = {"goal": "{name} within {limit:g} s", "measured": "{t:.1f} s", "reached": "t <= 2", "stretch": "t <= 1"}
    made = [list(row.values()) for row in render.judged([render.Goal(**goal)])({"rows": rows})]
    assert made == [["a within 2 s", "1.5 s", True, False], ["b within 2 s", "3.0 s", False, False],
                    ["e within 2 s", "- s", None, None]]  # fmt: skip
    always = render.Goal(**goal, always=True, where="name not 'b'")
    found = [list(row.values())[1:] for row in render.judged([always], lambda _: rows)({})]
    assert found == [["1.5 s", True, False], ["-", None, None], ["x", False, False], ["- s", None, None]]
    both = [render.Goal("{name} one", "", "t > 0"), render.Goal("{name} two", "", "t > 0")]
    told = {way: [row["goal"] for row in render.judged(both, way)({"rows": rows[:2]})] for way in (None, "rows")}
    assert told == {None: ["a one", "b one", "a two", "b two"], "rows": ["a one", "a two", "b one", "b two"]}
