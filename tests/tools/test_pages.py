"""Pages of the documentation: a person writes them, and their slots say what was recorded."""

import json
import re
import shutil
from pathlib import Path

import pytest
from bench import pages, record, slots

from .conftest import shown

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NAMES = (
    "benchmarks.md",
    "configuration.md",
    "contact.md",
    "fit.md",
    "flag_benchmark.md",
    "from_photos.md",
    "gallery.md",
    "live.md",
    "many.md",
    "air.md",
    "nature.md",
    "recording.md",
    "stability.md",
    "training.md",
    "validation.md",
    "web.md",
    "wind.md",
)


def _copy(folder):
    shutil.copytree(DOCS / "results", folder / "docs/results")
    for name in NAMES:
        shutil.copy(DOCS / name, folder / "docs")
    return folder / "docs"


def test_the_committed_pages_say_what_is_recorded():
    """Filled again they are the same, so no number in a slot is typed by hand."""
    found = pages.fill(DOCS, record.read(DOCS / "results"))
    assert {path.name for path in found} >= {*NAMES, "README.md"}
    for path, text in found.items():
        assert text == path.read_text(), f"{path.name} is not what docs/results says: run `python tools/bench.py pages`"


def test_no_page_says_that_something_is_not_recorded_yet():
    """A table without rows leaves its place empty, with the sentence that introduces it."""
    missing = re.compile(r"not (recorded|measured|shown) yet", re.IGNORECASE)
    assert missing.search("| a GPU | Not recorded yet. |")
    pages_of_users = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
    assert [path.name for path in pages_of_users if missing.search(path.read_text(encoding="utf-8"))] == []


def test_pages_are_filled_in_place_and_their_plots_drawn(bench, tmp_path):
    docs = _copy(tmp_path)
    emptied = docs / "validation.md"
    text = emptied.read_text()
    begin = "<!-- begin: accuracy.goals -->\n"
    before, _, after = text.partition(begin)
    emptied.write_text(before + begin + after[after.index("<!-- end -->") :])
    bench("pages", "--keep_ages", "--results", docs / "results")
    for name in NAMES:
        assert (docs / name).read_text() == (DOCS / name).read_text(), name
    for picture in (
        "convergence.png",
        "drape.png",
        "nature.png",
        "pareto_cpu.png",
        "pareto_cuda.png",
        "speed_cpu.png",
        "speed_cuda.png",
        "stability.png",
        "trees.png",
        "wrinkles.png",
    ):
        assert (docs / "pictures" / picture).stat().st_size > 10_000
        assert (DOCS / "pictures" / picture).exists()
        assert any(f"(pictures/{picture})" in (DOCS / name).read_text() for name in NAMES)


def test_what_is_recorded_reaches_the_page(tmp_path):
    docs = _copy(tmp_path)
    path = docs / "results/flags_cuda.json"
    recorded = json.loads(path.read_text())
    ours = recorded["rows"]["ours"]["2"]
    ours["chamfer_share"] = 0.1234
    path.write_text(json.dumps(recorded))
    text = pages.fill(docs, record.read(docs / "results"))[docs / "flag_benchmark.md"]
    assert "<!-- begin: flags.distance flags_cuda ours 2 -->12.34 %<!-- end -->" in text
    table = [line for line in text.splitlines() if line.startswith("| ours (`total`") and "| 12.34 % |" in line]
    assert f" | {ours['mean']['psnr_db']:.2f} | " in table[0]


def test_a_slot_that_a_page_lacks_is_named_with_its_page(bench, tmp_path):
    docs = _copy(tmp_path)
    before = {name: (docs / name).read_text() for name in NAMES}
    shutil.copy(docs / "results/sim_cpu.json", docs / "results/sim_mps.json")
    with pytest.raises(SystemExit, match=r"^error: benchmarks\.md lacks the slot `runs\.whole sim_mps`: add"):
        bench("pages", "--results", docs / "results")
    assert before == {name: (docs / name).read_text() for name in NAMES}
    (docs / "results/sim_mps.json").unlink()
    (docs / "training.md").unlink()
    with pytest.raises(SystemExit, match=r"There is no .*training\.md, which has .* `training\.goals train_cuda`"):
        bench("pages", "--results", docs / "results")


RECORDS = {"long_flag": {"damped": {"damping_per_s": 0.25}}, "sim_cpu": {"runs": []}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a <!-- begin: no.such -->x<!-- end -->", r"page\.md: slot `no\.such` cannot be filled: it is unknown; the"),
        ("a <!-- begin: -->x<!-- end -->", r"page\.md: slot `` "),
        ("a <!-- begin: runs.whole -->x<!-- end -->", r"slot `runs\.whole` .* comes a recorded file, sim_\*"),
        ("a <!-- begin: runs.whole sim_x -->x<!-- end -->", r"`runs\.whole sim_x` .* no sim_x\.json among"),
        (
            "a <!-- begin: runs.whole sim_cpu 3 -->x<!-- end -->",
            r"`runs\.whole sim_cpu 3` .* 0 more words, not 1",
        ),
        (
            "a <!-- begin: long_flag.damping long_flag wet -->x<!-- end -->",
            r"`long_flag.damping .* there is no 'wet\.damping",
        ),
        (
            "a <!-- begin: runs.whole sim_cpu -->x<!-- end -->",
            r"`runs\.whole sim_cpu` cannot be filled: .* 'device'",
        ),
        ("a <!-- begin: x -->", r"page\.md: slot `x` has no `<!-- end -->`"),
        (
            "a <!-- begin: x --> <!-- begin: y --> <!-- end -->",
            r"page\.md, line 1: slot `x` has no .* before the next",
        ),
        ("\n a <!-- end -->", r"page\.md, line 2: `<!-- end -->` ends no slot"),
        ("a <!-- begin: long_flag.damping long_flag damped -->\nx<!-- end -->", r"`long_flag\.damping .* in its line"),
        ("<!-- begin: long_flag.damping long_flag damped -->x<!-- end -->", r"`long_flag\.damping .* starts its line"),
        ("<!-- begin: long_flag.damping long_flag damped -->\n<!-- end -->", r"needs its comments on one line with"),
    ],
)
def test_a_slot_that_cannot_be_filled_is_named_with_its_page(text, message):
    with pytest.raises(slots.SlotError, match=message):
        slots.fill("page.md", text, RECORDS)


def test_a_table_within_a_sentence_is_refused():
    text = "a <!-- begin: long_flag.minutes long_flag -->x<!-- end -->"
    records = {"long_flag": json.loads((DOCS / "results/long_flag.json").read_text())}
    with pytest.raises(slots.SlotError, match=r"`long_flag\.minutes .* needs its comments on lines of"):
        slots.fill("page.md", text, records)


def test_only_what_is_between_the_comments_changes():
    text = "It is <!-- begin: long_flag.damping long_flag damped -->7 /s<!-- end -->.  \n\n"
    text += "<!-- a note -->\n`<!-- begin: x -->`\n"
    filled = slots.fill("page.md", text, RECORDS)
    assert filled == text.replace("7 /s", "0.25 1/s")
    assert slots.fill("page.md", filled, RECORDS) == filled
    assert slots.used(text) == ["long_flag.damping long_flag damped"]


def test_growth_of_an_energy():
    """Of one that grows by two per cent a minute."""
    run = {"energy_per_minute_J": {"mechanical": [3 * 1.02**minute for minute in range(10)]}}
    assert shown("long_flag.growth", {"run": run}, "run") == "2.0 %"
