"""The page, parsed as HTML."""

import base64
import re
from html.parser import HTMLParser

import pytest

from dgae_jax.report import results
from dgae_jax.report.page import page
from dgae_jax.report.results import Published
from tests.report.rows import plain, row, study, whole

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Reader(HTMLParser):
    """Tags with their attributes, and words; every tag must be closed in its turn."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self.open, self.source = [], [], [], text
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.open += [] if tag in VOID else [tag]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words += [" ".join(data.split())] if data.strip() else []

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]

    def values(self, *names):
        return [each[name] for _, each in self.tags for name in names if name in each]

    def text_of(self, tag):
        return re.findall(rf"<{tag}\b[^>]*>([^<]*)", self.source)


@pytest.fixture
def read(tmp_path):
    """The page of rows."""

    def read(*sweeps, published=()):
        named = [study(tmp_path / f"sweep-{number}", rows) for number, rows in enumerate(sweeps)]
        return Reader(page([results.read(path) for path in named], published))

    return read


def test_page_needs_no_other_file_and_its_links_lead_to_headings(read):
    found = read(whole(("hopper",), ("ppo", "dppo"), 2))
    assert not {"script", "link", "iframe", "object", "embed"} & {tag for tag, _ in found.tags}
    assert not re.search(r"@import|url\(", found.source)
    sources = found.values("src", "href", "srcset", "poster")
    assert all(source.startswith(("data:", "#")) for source in sources)
    ids = found.values("id")
    assert len(ids) == len(set(ids))
    links = {link["href"] for link in found.all("a")}
    assert len(links) == 8
    assert links <= {f"#{each}" for each in ids}


def test_pictures_are_whole_and_their_alternative_texts_have_the_numbers(read):
    found = read(plain([1000, 2000], algo="ppo") + plain([3000, 3100], algo="dppo"))
    for picture in found.all("img"):
        kind, data = picture["src"].split(",")
        assert kind == "data:image/svg+xml;base64"
        assert base64.b64decode(data).rstrip().endswith(b"</svg>")
    returns, curves, improvement, *_ = found.values("alt")
    assert returns == "Final returns on hopper-v4: PPO 1,500, DPPO 3,050."
    assert re.search(r"Learning curves on hopper-v4; .*: PPO [\d,]+, DPPO [\d,]+\.$", curves)
    assert improvement == "Probability of improvement: DPPO over PPO on hopper-v4 1.00."


def test_content_of_files_is_escaped(read):
    evil = '<script>alert("x")</script>'
    written = row() | dict.fromkeys(("cell", "env", "command", "git_revision"), evil)
    written |= {"machine": {evil: evil}, "versions": {evil: evil}, "env_version": None}
    written["config"] |= {evil: {"a": evil}}
    found = read([written])
    assert "<script" not in found.source
    assert evil in "".join(found.words)


def test_settings_that_differ_from_the_first_of_the_algorithm_are_marked(read):
    first = row("hopper", "ppo")
    policy = first["config"]["policy"] | {"initial_std": 3.0}
    changed = {"env": "walker2d", "num_envs": 7, "gamma": 0.5, "policy": policy}
    second = row("walker2d", "ppo", config=first["config"] | changed)
    found = read([first, second, row("swimmer", "dppo")])
    assert found.text_of("mark") == ["walker2d", "7", "0.5", "3.0"]
    assert first["command"] in found.text_of("pre")[0]
    assert {"jax", "0.10.2", "machine: device", "git revision"} <= set(found.words)


def test_summary_counts_runs_and_names_those_without_a_result(tmp_path):
    diverged = row(seed=1, final={"engine": "jax", "return_mean": None, "returns": [None]})
    path = study(tmp_path / "some", [row(), diverged], planned=["hopper-dppo-2"])
    (summary,) = re.findall("<p>(.*?)</p>", page([results.read(path)]), re.DOTALL)
    words = "1 trained run: 1 task, 1 algorithm, 1 seed, 1,000,000 environment steps each."
    assert words in " ".join(summary.split())
    assert "hopper-dppo-2." in summary
    assert "seed 1 of hopper-dppo-1." in summary


def test_video_of_a_task_is_embedded(tmp_path):
    brax = row() | {"env": "brax:ant", "env_version": None, "cell": "b"}
    path = study(tmp_path / "videos", [row(), row("ant"), brax])
    (path / "videos").mkdir()
    for name in ("hopper", "brax-ant"):
        (path / "videos" / f"{name}.mp4").write_bytes(name.encode())
    sources = [video["src"] for video in Reader(page([results.read(path)])).all("video")]
    prefix = "data:video/mp4;base64,"
    assert [base64.b64decode(src.removeprefix(prefix)) for src in sources] == [
        b"hopper",
        b"brax-ant",
    ]


def test_published_results_of_its_tasks_are_listed_with_their_sources(read):
    hopper = Published("hopper", 10**6, "PPO", 2609.0, 701.0, 10, "Tianshou")
    ant = Published("ant", 10**6, "PPO", 3258.0, None, None, "Other")
    words = read([row()], published=[hopper, ant]).words
    end = words.index("Tianshou")
    assert words[end - 2 : end] == ["2,609 ± 701", "10"]
    assert "Other" not in words


def test_sweeps_are_compared_first(read):
    found = read(plain([1000, 3000]), plain([4000, 4000]))
    assert found.text_of("h2") == ["Comparison", "sweep-0", "sweep-1", "Deviations from the paper"]
    assert "+2,000 [+1,000, +3,000]" in found.words
    ids = found.values("id")
    assert len(ids) == len(set(ids))
    assert {link["href"][1:] for link in found.all("a")} <= set(ids)
