"""The report: pages that are self-contained and complete, linked both ways, without a figure that the summary does not hold."""

import base64
import json
from html.parser import HTMLParser

import numpy as np
import pytest

from learn import analysis, compare, report
from learn.baselines import Frozen, Oracle
from sim.errors import InputError
from sim.trajectory import Trajectory

PIXEL = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg==")
VERDICT = "On hand, no learned model wins at equal error; the solver is 3 times faster. Missed: speed < 1 & error."
VOID = {"meta", "img", "br", "hr", "link", "input", "source"}


def trajectory(seed, kinematic=True) -> Trajectory:
    path = 0.4 + np.random.default_rng(seed).normal(0, 2e-3, (16, 10, 2)).cumsum(axis=0) + 0.04 * np.arange(10)[:, None]
    kinds = np.array([5] * 9 + [3 if kinematic else 5], np.int8)
    path += 0.02 * np.arange(16)[:, None, None] - 0.3
    path[:, kinds == 3] = 0.9
    scene = {"name": "hand", "gravity": [0, -9.81], "spacing": 0.05}
    return Trajectory(path.astype(np.float32), kinds, 0.01, 0.1, np.array([[0.0, 1.0]] * 2), scene, seed, {"name": "hand"})


class Off(Oracle):
    """The truth plus an offset, under any kind; from frame ``fails_at`` on it is not a number."""

    def __init__(self, name, kind, truths, offset, fails_at=99):
        super().__init__(truths)
        self.name, self.kind, self.offset, self.fails_at, self.settings = name, kind, offset, fails_at, {"offset": offset}

    def advance(self):
        block = super().advance() + np.float32(self.offset)
        return block * np.nan if self.frame >= self.fails_at else block


def make_rows(kinematic=True) -> list[dict]:
    """Rows as the comparison makes them, with times and costs set by hand."""
    truths = [trajectory(seed, kinematic) for seed in range(3)]
    contenders = [
        Off("gns", "learned", truths, 0.02),
        Off("dead", "learned", truths, 0.0, fails_at=8),
        Off("rung", "solver", truths, 0.01),
        Off("teacher", "reference", truths, 0.0),
        Frozen(),
        Oracle(truths),
        Off("floor", "floor", truths, 1e-3),
    ]
    rows = compare.compare(contenders, truths, compare.CompareSettings(horizons=(1, 5, 100), one_step_samples=2, curve_points=5))
    seconds = {"gns": 3e-3, "dead": 3e-3, "rung": 1e-3, "teacher": 9e-3}
    timings = [compare.Timing(name, 0.01, 10, 0.7, [value * 0.9, value, value * 1.3]) for name, value in seconds.items()]
    rows = compare.attach_timing(rows, timings, "hand")
    for row in rows:
        if row["contender"] == "gns":
            row["cost"] = {"generation_seconds": 90.0, "training_seconds": 600.0, "trajectories": 100}
    return rows


@pytest.fixture(scope="module")
def rows():
    return make_rows()


@pytest.fixture
def assets(tmp_path):
    for name in ("film.mp4", "poster.png", "figure.svg", "curve.png"):
        (tmp_path / name).write_bytes(PIXEL)
    asset = report.Asset
    return {
        "hand": report.SceneAssets(
            films=[asset(tmp_path / "film.mp4", "solver, model, error", tmp_path / "poster.png")],
            stills=[asset(tmp_path / "poster.png", "the end")],
            main=[asset(tmp_path / "figure.svg", 'error "over" <run time>')],
            figures=[asset(tmp_path / "figure.svg", "over time", wide=True)],
            training=[asset(tmp_path / "curve.png", "loss")],
        )
    }


class Page(HTMLParser):
    """Tags with attributes, text of paragraphs, tables as {caption: [[cell, ...], ...]}; fails on tags that do not match."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.paragraphs, self.tables = [], [], [], {}
        self.heading = ""
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "p":
            self.paragraphs.append("")
        elif tag == "h3":
            self.heading = ""
        elif tag == "table":
            self.tables[self.heading] = []
        elif tag == "tr":
            self.tables[self.heading].append([])
        elif tag in ("td", "th"):
            self.tables[self.heading][-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        if "p" in self.open:
            self.paragraphs[-1] += text
        elif self.open and self.open[-1] == "h3":
            self.heading += text
        elif "td" in self.open or "th" in self.open:
            self.tables[self.heading][-1][-1] += {"small": " | ", "sup": "^"}.get(self.open[-1], "") + text

    def table(self, beginning) -> dict[str, list[str]]:
        """Rows by the contender's name."""
        found = next(rows for caption, rows in self.tables.items() if caption.startswith(beginning))
        return {row[0].split(" | ")[0]: row for row in found}


def write(tmp_path, rows, assets=None, page="hand", overview=(), **more):
    """Text and tags of a scene's page, or of the entry (None)."""
    summary = compare.summary(rows) | {"verdict": VERDICT} | more
    json.dumps(summary, allow_nan=False)
    report.write_report(summary, tmp_path / "report.html", assets, overview)
    text = (tmp_path / ("report.html" if page is None else f"report/{page}.html")).read_text(encoding="utf-8")
    return text, Page(text)


def check_self_contained(text, page, count):
    """No script, no network, every picture inside the page; links lead to pages of the report alone."""
    names = [tag for tag, _ in page.tags]
    assert "script" not in names and "link" not in names and "iframe" not in names
    media = [attributes for tag, attributes in page.tags if tag in ("img", "video")]
    assert len(media) == count and all(attributes["src"].startswith("data:") for attributes in media)
    assert "http:" not in text and "https:" not in text and "url(" not in text and "@import" not in text
    assert any(attributes.get("name") == "viewport" for _, attributes in page.tags)
    return media


def test_the_entry_stands_alone_and_begins_with_the_verdict(tmp_path, rows, assets):
    provenance = {"commands": ["make demo"], "seeds": {"train": [1, 2]}, "revision": "abc1"}
    overview = [report.Asset(tmp_path / "figure.svg", "speed-ups")]
    text, page = write(tmp_path, rows, assets, None, overview, title="Sand & water", provenance=provenance)
    assert page.paragraphs[0] == VERDICT
    first, still, main = check_self_contained(text, page, 3)
    assert first["alt"] == "speed-ups"
    assert still["src"].startswith("data:image/png") and still["alt"] == "solver, model, error Half way."
    assert main["src"].startswith("data:image/svg+xml") and main["alt"] == 'error "over" <run time>'
    for expected in ("Sand &amp; water", "make demo", "<dt>train</dt><dd>1, 2</dd>", "abc1", "numpy", "10 predicted frames of 10 ms"):
        assert expected in text
    assert page.table("Cost of data and training")["gns"][1:] == ["90 s", "10 min", "100"]
    assert sorted(entry.name for entry in tmp_path.glob("*.html")) == ["report.html"]
    assert [entry.name for entry in (tmp_path / "report").iterdir()] == ["hand.html"]


def test_the_page_of_a_scene_holds_all_of_it(tmp_path, rows, assets):
    text, page = write(tmp_path, rows, assets)
    assert page.paragraphs[0] == analysis.scene_verdict(rows)
    media = check_self_contained(text, page, 5)
    film = next(attributes for tag, attributes in page.tags if tag == "video")
    assert film["src"].startswith("data:video/mp4;base64,") and film["poster"].startswith("data:image/png;base64,")
    assert base64.b64decode(film["src"].split(",")[1]) == PIXEL
    assert sorted(attributes["alt"] for attributes in media if "alt" in attributes) == ['error "over" <run time>', "loss", "over time", "the end"]
    assert any(tag == "figure" and attributes["class"] == "chart wide" for tag, attributes in page.tags)


def links(page):
    return [attributes["href"] for tag, attributes in page.tags if tag == "a"]


def test_pages_are_linked_both_ways(tmp_path, rows):
    rows = rows + [row | {"scene": "sand"} for row in rows] + [row | {"reference": "fine teacher"} for row in rows]
    text, entry = write(tmp_path, rows, page=None)
    pages = {"hand-teacher", "sand", "hand-fine-teacher"}
    anchors = {attributes.get("id") for _, attributes in entry.tags}
    assert set(links(entry)) == {f"report/{page}.html" for page in pages} and pages <= anchors
    for page in pages:
        _, other = write(tmp_path, rows, page=page)
        assert set(links(other)) == {f"../report.html#{page}", "../report.html#provenance", *(f"{each}.html" for each in pages - {page})}
    assert text.count(analysis.scene_verdict(rows[:7])) == 1  # among several scenes each has its verdict in the entry as well


def test_pages_of_an_earlier_report_go(tmp_path, rows):
    write(tmp_path, [row | {"scene": "sand"} for row in rows], page="sand")
    write(tmp_path, rows)
    assert [entry.name for entry in (tmp_path / "report").iterdir()] == ["hand.html"]


def test_scenes_at_a_glance(tmp_path, rows):
    failed = [row | {"scene": "mud"} for row in rows if row["contender"] != "gns"]
    text, page = write(tmp_path, rows + failed, page=None)
    table = page.table("At a glance; error: rollout MSE of moving particles over all frames")
    trivial = analysis.MOVING_MSE.of(next(row for row in rows if row["contender"] == "frozen"))
    assert table["hand"][:5] == ["hand | truth: teacher", "gns", "4.0e-4", report.number(trivial), "3 ms"]
    assert table["hand"][5:] == ["0.33× | loses", "rung", "0.33× | loses", "3×", "never"]
    assert table["mud"][1:] == ["–^1", *["–"] * 8] and "none finished every rollout" in text
    assert "None of these scenes is one of the sixteen domains" in text


def test_a_domain_of_the_paper_stands_beside_its_table(tmp_path, rows):
    stiff = [row | {"scene": "waterdrop-stiff"} for row in rows]
    box = [row | {"scene": "boxbath", "settings": {"model": "gns"}} for row in rows if row["contender"] != "dead"]
    text, page = write(tmp_path, rows + stiff + box, page=None)
    caption = next(caption for caption in page.tables if caption.startswith("Beside Table 1"))
    (_, _, first, gns, dead, second, box_gns) = page.tables[caption]
    assert first[0] == "WATERDROP, stiff" and second[0] == "BOXBATH"
    assert gns[1:4] == ["4.0e-4 | 1.5e-9", "4.0e-4 | 7.0e-3", "0.057×"]
    assert gns[4:] == ["– | gns", "– | 1,591,826", "100 | 1,000", "– | 20,000,000", "10 min | –", "10 | 1,000", "10 | 1,000"]
    assert dead[1].startswith("–^") and dead[3].startswith("–^") and dead[8].startswith("–^")
    assert box_gns[3:6] == ["0.095×", "gns | gns", "– | 1,592,979"] and box_gns[-2:] == ["10 | 1,000", "10 | 150"]
    assert "multiplied by 100 to 160" in text and "None of these scenes" not in text


def test_what_the_steps_took(tmp_path, rows):
    jobs = [
        {"rule": "train", "jobs": 2, "seconds": 90.0, "longest_seconds": 60.0, "memory_mb": 512.0},
        {"rule": "training_curve", "jobs": 1, "seconds": 0.5, "longest_seconds": 0.5, "memory_mb": None},
    ]
    _, page = write(tmp_path, rows, page=None, jobs=jobs)
    table = page.table("The workflow's steps")
    assert table["train"][1:] == ["2", "90 s", "60 s", "510 MB"] and table["training curve"][-1] == "–^1" and table["all"][1:3] == ["3", "90.5 s"]


def test_every_table_scrolls_in_its_own_box(tmp_path, rows):
    text, page = write(tmp_path, rows)
    assert text.count("<table>") == len(page.tables) == 5
    assert text.count('<div class="scroll"') == 5
    for table in page.tables.values():
        assert len({len(row) for row in table[1:] if len(row) > 2}) == 1  # the first row groups columns, headings of kinds span them


def test_contenders_are_grouped_and_carry_the_figures_of_the_rows(tmp_path, rows):
    _, page = write(tmp_path, rows)
    table = page.table("Contenders")
    order = ["reference", "teacher", "solver ladder", "rung", "learned", "gns", "dead", "trivial baselines", "frozen", "oracle", "chaos floor"]
    assert [name for name in table if name in order] == order
    columns = next(row for row in page.tables[next(iter(page.tables))] if row[0] == "contender")
    gns = dict(zip(columns[1:6], table["gns"][1:6], strict=True))
    # Columns repeat for the moving particles, so the first five are those of all particles.
    assert gns["one step"] == "4.0e-4" and gns["1 frame"] == "4.0e-4" and gns["5 frames"] == "4.0e-4"
    assert gns["100 frames"].startswith("–^") and gns["all"].startswith("4.0e-4")
    assert columns.count("one step") == 2
    assert table["gns"][columns.index("all / R²")].startswith("0.04")
    assert table["gns"][columns.index("per frame")] == "3 ms | 2.7 ms to 3.9 ms"
    assert table["gns"][columns.index("compile")] == "700 ms"
    assert table["gns"][columns.index("diverges, s")] == "never"
    assert len(table["gns"][columns.index("EMD, spacings")].split(" / ")) == 4


def test_missing_figures_are_dashes_with_their_reason(tmp_path, rows):
    text, page = write(tmp_path, rows)
    table = page.table("Contenders")
    columns = table["contender"]
    assert table["rung"][columns.index("one step")].startswith("–^")
    dead = table["dead"]
    assert dead[columns.index("Sinkhorn")].startswith("–^") and dead[columns.index("failures")].startswith("3 of 3^")
    for reason in ("restarts from a scene only", "dead: failed in 3 of 3", "the runs have 10 frames", "not interleaved"):
        assert reason in text
    assert "nan" not in [cell for row in table.values() for cell in row] and "None" not in text


def test_moving_particles_are_shown_apart_only_where_they_differ(tmp_path):
    _, page = write(tmp_path, make_rows(kinematic=False))
    assert page.table("Contenders")["contender"].count("one step") == 1


def test_particles_in_obstacles_are_shown_where_there_are_obstacles(tmp_path, rows):
    name = "in obstacles, end (worst)"
    _, page = write(tmp_path, rows)
    assert name not in page.table("Contenders")["contender"]
    sunk = [row | ({"penetrated_fraction": 0.02, "penetrated_fraction_worst": 0.3} if row["contender"] == "gns" else {}) for row in rows]
    _, page = write(tmp_path, sunk)
    table = page.table("Contenders")
    assert table["gns"][table["contender"].index(name)] == "2 % (30 %)" and table["rung"][table["contender"].index(name)].startswith("–")


def test_speed_ups_floor_and_costs(tmp_path, rows):
    _, page = write(tmp_path, rows)
    gns, dead = (page.table("What the learning bought")[name] for name in ("gns", "dead"))
    assert gns[1:4] == ["3×", "0.33× | loses", "rung"]
    assert gns[4:10] == ["0.33× | loses", "0.33× | loses", "4.0e-4", "1.0e-4", "4×", "rung"]
    assert gns[10:] == ["never", "11,500"]  # (90 + 600) s over 10 frames of (9 - 3) ms
    assert dead[2] == "– | failed" and dead[6].startswith("–^")
    over = page.table("MSE over the chaos floor")
    assert over["gns"][-1] == "400×" and over["rung"][-1] == "100×" and "teacher" not in over
    cost = page.table("Cost of data and training")
    assert cost["gns"][1:] == ["90 s", "10 min", "100"] and cost["contender"][-1] == "trajectories"


def test_speed_ups_of_each_training(tmp_path, rows):
    """The model of 3 ms errs by 4e-4, which a rung of 1 ms does as well; a second training by 1e-6, which takes the teacher's 9 ms."""
    _, page = write(tmp_path, rows)
    assert "each training" not in page.table("What the learning bought")["contender"]
    seeds = [{"seed": seed, "rollout_mse_moving": {"all": error}} for seed, error in enumerate((4e-4, 1e-6))]
    found = [row | ({"spread": row["spread"] | {"per_seed": seeds}} if row["contender"] == "gns" else {}) for row in rows]
    _, page = write(tmp_path, found)
    table = page.table("What the learning bought")
    column = table["contender"].index("each training")
    assert table["gns"][column] == "0.33 to 3× | loses, wins" and table["dead"][column].startswith("–^") and table["gns"][-2:] == ["never", "11,500"]


def test_clouds(tmp_path, rows):
    _, page = write(tmp_path, rows)
    table = page.table("Clouds at")
    row = next(row for row in rows if row["contender"] == "gns")
    quarters = ("0.25", "0.5", "0.75", "1")
    for heading, key in {"density, mean": "density_error_mean", "front, spacings": "front_error", "height": "height_ratio"}.items():
        shown = " / ".join("–" if row[key][at] is None else report.number(row[key][at]) for at in quarters)
        assert table["gns"][table["contender"].index(heading)] == shown, heading
    assert table["gns"][-1] == report.number(row["momentum_drift"]) and table["dead"][1].startswith("–^")
    # Moved by 0.02 along every axis, in spacings.
    assert table["gns"][table["contender"].index("centre of mass, spacings")] == " / ".join([report.number(row["centre_of_mass_error"]["1"])] * 4)


def test_times_of_fewer_frames_than_the_errors_say_so(tmp_path, rows):
    assert "run times of" not in write(tmp_path, rows)[0]
    fewer = [row | {"timing_spread": row["timing_spread"] | {"frames": 4}} if row.get("timing_spread") else row for row in rows]
    assert "known frames, run times of the first 4</p>" in write(tmp_path, fewer)[0]


def test_a_gpu_that_only_rolled_out_is_not_what_was_timed(tmp_path, rows):
    machine = {"cpu": "Some CPU", "gpu": "Some GPU"}
    text, _ = write(tmp_path, rows, hardware=machine)
    assert "Timed on one thread of Some CPU. " in text and "Some GPU" not in text
    there = [row | {"settings": row["settings"] | {"rolled out on": "Some GPU"}} if row["kind"] == "learned" else row for row in rows]
    text, _ = write(tmp_path, there, hardware=machine)
    assert "Timed on one thread of Some CPU; errors and films of learned models: Some GPU. " in text


def test_analysis_of_the_summary_is_used_as_it_is(tmp_path, rows):
    analysed = analysis.analyse(rows)
    analysed[0] |= {"speed_up_paper": 42.0, "worse_than_trivial": ["frozen"]}
    _, page = write(tmp_path, rows, analysis=analysed)
    gns = page.table("What the learning bought")["gns"]
    assert gns[1] == "42×" and gns[0] == "gns | worse than frozen"


def test_one_page_per_scene_and_reference(tmp_path, rows, assets):
    fine = [row | {"reference": "fine teacher"} for row in rows]
    other = [row | {"scene": "sand"} for row in rows]
    text, page = write(tmp_path, rows + fine + other, assets, None)
    assert text.count("<h2>hand, truth: ") == 2 and text.count("<h2>sand</h2>") == 1
    assert sum(tag == "img" for tag, _ in page.tags) == 2  # pictures belong to the scene, not to each reference


def test_text_is_escaped(tmp_path, rows):
    for page in (None, "hand"):
        text, _ = write(tmp_path, [rows[0] | {"contender": "<b>gns</b>"}], page=page, verdict="1 < 2 <script>", title="<b>")
        assert "<b>" not in text and "<script>" not in text


@pytest.mark.parametrize(("summary", "match"), [({"rows": [], "verdict": "v"}, "at least one row"), ({"rows": [{}]}, "begins with its verdict")])
def test_incomplete_summaries_are_refused(tmp_path, summary, match):
    with pytest.raises(InputError, match=match):
        report.write_report(summary, tmp_path / "report.html")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "match"), [("missing.png", "make the picture first"), ("film.avi", "a report embeds")])
def test_pictures_that_cannot_be_embedded_are_refused(tmp_path, rows, name, match):
    with pytest.raises(InputError, match=match):
        write(tmp_path, rows, {"hand": report.SceneAssets(stills=[report.Asset(tmp_path / name, "still")])})
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (1.234e-4, "1.2e-4"), (0.333, "0.33"), (1.0, "1"), (0.999, "1"), (17.4, "17"), (1234.0, "1200"), (123456.0, "1.2e5"), (9.96, "10")],
)
def test_numbers_have_two_digits(value, text):
    assert report.number(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(2e-6, "2 µs"), (8.4e-4, "840 µs"), (0.0123, "12.3 ms"), (7.0, "7 s"), (450.0, "7.5 min"), (11160.0, "3.1 h")]
)
def test_durations_have_units(value, text):
    assert report.duration(value) == text
