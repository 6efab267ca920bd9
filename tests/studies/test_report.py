"""A study's report: complete, self-contained, and harmless whatever people call their policies."""

from __future__ import annotations

import re
from base64 import b64decode
from html.parser import HTMLParser

import matplotlib
import pandas as pd
import pytest

from ctmhe.errors import InputError
from ctmhe.studies import Study, StudyResult
from ctmhe.studies.figures import Roles, pictures
from ctmhe.studies.report import make_page, write_report

matplotlib.use("agg")
HOSTILE = "<script>alert('$')</script> & $}$"


def case(*, seed, policy="even", budget=10, gain=1.0):
    """Return numbers like those of a run; one point fails."""
    if policy == "bad":
        raise ValueError("trigger 'Bad' <returned> NaN")
    return {"samples": budget + seed, "online_rms": gain * (2.0 if policy == "even" else 1.0) / (budget + seed)}


class Reader(HTMLParser):
    """Collects tags, text and addresses."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.text, self.links = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for key, value in attrs if key in ("src", "href") and value]

    def handle_data(self, data):
        self.text.append(data)


def test_a_report_says_what_was_run_and_what_came_out(tmp_path):
    """Design, seeds, means with intervals, differences, failures with their errors, how to go on."""
    folder = tmp_path / "reactor"
    result = Study(case, {"policy": ["even", "delta", "bad"], "budget": [10, 20]}, 3, folder=folder, name="tanks").run()
    path = write_report(folder, tmp_path / "deep" / "report.html")
    text = " ".join("".join(Reader(path.read_text("utf-8")).text).split())
    mean = result.summary("online_rms")["mean"].iloc[0]
    assert "tanks" in text and "18 runs" in text and "6 failed" in text
    assert f"{mean:.4g}" in text and "Compared with policy = even" in text
    assert "trigger 'Bad' <returned> NaN" in text and "ctmhe study report reactor" in text


def test_the_page_needs_nothing_else(tmp_path):
    """No scripts, no addresses but data."""
    result = Study(case, {"policy": ["even", "delta"], "budget": [10, 20]}, 3).run()
    page = Reader(make_page(result))
    assert page.links and all(link.startswith("data:image/svg+xml;base64,") for link in page.links)
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert all(b"<svg" in b64decode(link.partition(",")[2]) for link in page.links)


def test_what_people_name_is_text(tmp_path):
    """Labels, names and errors are escaped, and dollars in them are not mathematics."""
    labels = {HOSTILE: "even", "other": "delta"}

    def named(*, seed, policy):
        if seed == 2:
            raise ValueError(HOSTILE)
        return case(seed=seed, policy=policy)

    result = Study(named, {"policy": labels}, 3, name=HOSTILE).run()
    page = make_page(result)
    reader = Reader(page)
    assert "script" not in reader.tags and HOSTILE in "".join(reader.text)
    assert len(reader.links) == 2  # error against samples, differences


def test_the_same_study_gives_the_same_page():
    """Figures carry no dates and no random names."""
    result = Study(case, {"policy": ["even", "delta"], "budget": [10, 20, 40]}, 2).run()
    assert make_page(result) == make_page(result)


@pytest.mark.parametrize(
    ("grid", "count"),
    [
        ({}, 1),  # error against samples
        ({"policy": ["even", "delta"]}, 2),  # and differences
        ({"policy": ["even", "delta"], "budget": [10, 20]}, 3),  # and the front
        ({"budget": [10, 20, 30], "gain": [1.0, 2.0, 3.0]}, 4),  # and the heat map
        ({"policy": ["bad"]}, 0),
    ],
)
def test_figures_fit_the_design(grid, count):
    """As many as there is something to say."""
    assert make_page(Study(case, grid, 2).run()).count("<figure>") == count


def test_one_seed_and_missing_values_make_a_page_too():
    """Without intervals, and with `n/a`."""
    result = Study(case, {"policy": ["even", "delta"]}, 1).run()
    assert "<small>" not in make_page(result)
    table = result.table.assign(online_rms=float("nan"))
    empty = StudyResult(table, result.parameters, result.metrics, "empty")
    assert Roles.of(empty).error == "samples"
    assert pictures(empty, Roles.of(empty)) == [] and "n/a" in make_page(empty)


def test_a_study_that_is_not_finished_says_so(tmp_path):
    """What is there is reported."""
    Study(case, {"policy": ["even", "delta"]}, 2, folder=tmp_path / "s").run()
    next((tmp_path / "s" / "runs").glob("*.parquet")).unlink()
    assert "3 of 4 runs are finished" in make_page(StudyResult.load(tmp_path / "s"))


def test_the_baseline_can_be_chosen():
    """By label, and an unknown one is an error."""
    result = Study(case, {"policy": ["even", "delta"]}, 2).run()
    assert "Compared with policy = delta" in make_page(result, {"policy": "delta"})
    with pytest.raises(InputError, match="did you mean 'delta'"):
        make_page(result, {"policy": "dleta"})


def test_a_folder_without_a_study_is_an_error(tmp_path):
    """It is named."""
    with pytest.raises(InputError, match=re.escape(f"there is no study in {str(tmp_path)!r}")):
        write_report(tmp_path, tmp_path / "report.html")


def test_a_long_study_shows_its_first_rows():
    """More are in the table's file."""
    frame = pd.DataFrame({"k": range(250), "seed": 0, "cost": 1.0, "error": "", "seconds": 0.1, "key": "x"})
    page = make_page(StudyResult(frame, ("k",), ("cost",), "long"))
    assert "The first 200 of 250 rows" in page
