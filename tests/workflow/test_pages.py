"""Pages of reports in a real browser: what the check would find, and the page of a stability study. Those of a comparison: ``test_end_to_end``."""

import numpy as np
import pytest
from browser import PHONE, check, look, needs_browser

from sim.stability import Cell, Series
from sim.stability.report import row, verdict, write_page, write_report

pytestmark = needs_browser

SOUND = '<!DOCTYPE html><html><head><meta charset="utf-8"></head><body style="margin: 0">{}</body></html>'
FAULTS = {
    "a word on the console": ('<script>console.error("alas")</script>', "alas"),
    "an exception": ("<script>undefined.x</script>", "TypeError"),
    "a broken picture": ('<img src="data:image/png;base64,AAAA">', "IMG 0"),
    "a broken film": ('<img src="data:,"><video src="data:video/mp4;base64,AAAA"></video>', "VIDEO 1"),
    "a broken poster": ('<video poster="data:image/png;base64,AAAA" src="data:video/mp4;base64,AAAA"></video>', "IMG 1"),
    "a picture from elsewhere": ('<img src="/elsewhere.png">', "asks for /elsewhere.png"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_browser_sees(tmp_path, name):
    body, fault = FAULTS[name]
    assert any(fault in line for line in look(SOUND.format(body), tmp_path, PHONE).faults)


def test_the_browser_sees_what_is_too_wide_and_nothing_else(tmp_path):
    seen = look(SOUND.format('<div style="width: 400px">wide</div>'), tmp_path, PHONE)
    assert seen.width == 400 and not seen.faults
    seen = look(SOUND.format('<div style="width: 300px">narrow</div>'), tmp_path, PHONE)
    assert seen.width == PHONE and not seen.faults


def test_the_page_of_a_stability_study(tmp_path):
    curve = {"a": Series(("time", "energy"), np.linspace(0, 1, 50), np.linspace(1, 0, 50))}
    cells = [
        Cell("rest", "a_name_of_one_word_that_is_long_enough_for_no_phone" * 2, True, "speed at round-off", "1e-9 m/s", {"speed": 1e-9}, 0.1, curve),
        Cell("impact", "sand on a plate", False, "stays inside " * 9, "some outside " * 9, {"escaped": 0.5, "largest_step": 1e-3}, 0.2),
    ]
    rows = [row(cell) for cell in cells]
    summary = {"title": "Stress", "verdict": verdict(rows), "rows": rows, "hardware": {"cpu": "x" * 80}, "versions": {}}
    write_report(summary | {"provenance": {"command": "make"}}, tmp_path / "report.html")
    assert len(check(tmp_path / "report.html", tmp_path / "browser").media) == 1
    write_page(summary, tmp_path / "stability.md")
    text = (tmp_path / "stability.md").read_text()
    assert "1 of 2 cells of 2 cases react as they should." in text
    assert "| `rest`: No gravity, no motion: a block of each material stays where it is for ten thousand steps | 1 | 1 | 0.1 |" in text
    assert "| `impact` | sand on a plate | " in text.split("## Wrong")[1]
