"""The page, parsed as HTML."""

import base64
import re
from html.parser import HTMLParser

import pytest

from dgae_jax.report import results
from dgae_jax.report.page import PARTS, page
from dgae_jax.report.published import Published
from tests.report.rows import plain, row, study, whole

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Reader(HTMLParser):
    """Tags with their attributes, text, and whether every tag is closed in its turn."""

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
        self.words.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]

    def text_of(self, tag):
        return re.findall(rf"<{tag}\b[^>]*>([^<]*)", self.source)


@pytest.fixture
def read(tmp_path):
    """The page of rows, and its parts."""

    def read(*studies):
        named = [study(tmp_path / f"study-{number}", rows) for number, rows in enumerate(studies)]
        text = page([results.read(path) for path in named])
        return text, Reader(text)

    return read


def test_the_page_needs_no_other_file_and_no_script(read):
    text, found = read(whole(("hopper", "ant"), ("ppo", "dppo"), 2))
    assert not {"script", "link", "iframe", "object", "embed"} & {tag for tag, _ in found.tags}
    sources = [
        attributes[name]
        for _, attributes in found.tags
        for name in ("src", "href", "srcset", "poster")
        if name in attributes
    ]
    assert len(sources) > 5
    assert all(source.startswith(("data:", "#")) for source in sources)
    assert not re.search(r"@import|url\(", text)


def test_links_lead_to_headings_and_identities_are_there_once(read):
    _, found = read(whole(("hopper",), ("ppo", "dppo"), 2))
    identities = [attributes["id"] for _, attributes in found.tags if "id" in attributes]
    assert len(identities) == len(set(identities))
    links = [attributes["href"][1:] for attributes in found.all("a")]
    assert len(links) == len(PARTS)  # all but the videos, and the deviations
    assert set(links) <= set(identities)


def test_pictures_are_whole_and_say_what_they_show(read):
    _, found = read(plain([1000, 2000], algo="ppo") + plain([3000, 3100], algo="dppo"))
    pictures = found.all("img")
    for picture in pictures:
        kind, data = picture["src"].split(",")
        assert kind == "data:image/svg+xml;base64"
        assert base64.b64decode(data).rstrip().endswith(b"</svg>")
    alts = [picture["alt"] for picture in pictures]
    assert "Final returns on hopper-v4: PPO 1,500, DPPO 3,050." in alts
    assert "Probability of improvement: DPPO over PPO on hopper-v4 1.00." in alts
    assert all(alts)


def test_what_comes_from_outside_is_escaped(read):
    evil = '<script>alert("x")</script>'
    fields = dict.fromkeys(("cell", "env", "command", "git_revision"), evil)
    more = {
        "machine": {evil: evil},
        "versions": {evil: evil},
        "config": {evil: {"a": evil}},
        "env_version": None,
    }
    text, found = read([row() | fields | more])
    assert "<script" not in text
    assert evil in "".join(found.words)


def test_settings_that_differ_from_the_first_of_the_algorithm_are_highlighted(read):
    first = row("hopper", "ppo")
    policy = first["config"]["policy"] | {"initial_std": 3.0}
    changed = {
        "env": "walker2d",
        "num_envs": 7,
        "num_steps": 9,
        "gamma": 0.5,
        "lam": 0.25,
        "policy": policy,
    }
    _, found = read(
        [
            first,
            row("walker2d", "ppo") | {"config": first["config"] | changed},
            row("swimmer", "dppo"),
        ]
    )
    assert found.text_of("mark") == ["walker2d", "7", "9", "0.5", "0.25", "3.0"]


def test_every_command_is_there_with_versions_and_machines(read):
    rows = whole(("hopper",), ("ppo",), 3)
    text, found = read(rows)
    assert [each["command"] in text for each in rows] == [True] * 3
    assert {"jax", "0.10.2", "machine: device", "git revision"} <= set(found.words)


def test_cells_without_a_result_are_named(tmp_path):
    path = study(tmp_path / "some", [row()], planned=["hopper-dppo-1", "hopper-dppo-2"])
    assert "Cells without a result: hopper-dppo-1, hopper-dppo-2." in page([results.read(path)])


def test_one_seed_has_dashes_for_intervals_and_one_algorithm_no_pairs(read):
    _, found = read([row()])
    assert (
        "1 trained run: 1 task, 1 algorithm, 1 seed, 1,000,000 environment steps each."
        in found.words
    )
    assert any(word.endswith("[–]") for word in found.words)
    assert "Probability of improvement" not in found.words


def test_a_video_of_a_task_is_in_the_page(tmp_path):
    path = study(
        tmp_path / "films",
        [row(), row("ant"), row() | {"env": "brax:ant", "env_version": None, "cell": "b"}],
    )
    (path / "videos").mkdir()
    for name in ("hopper", "brax-ant"):
        (path / "videos" / f"{name}.mp4").write_bytes(name.encode())
    films = Reader(page([results.read(path)])).all("video")
    assert [
        base64.b64decode(film["src"].removeprefix("data:video/mp4;base64,")) for film in films
    ] == [b"hopper", b"brax-ant"]


def test_published_results_are_listed_with_their_sources(tmp_path):
    known = [
        Published("hopper", 10**6, "PPO", 2609.0, 701.0, 10, "Tianshou"),
        Published("ant", 10**6, "PPO", 3258.0, None, None, "Other"),
    ]
    words = Reader(page([results.read(study(tmp_path / "one", [row()]))], known)).words
    assert words[words.index("2,609 ± 701") : words.index("Tianshou") + 1] == [
        "2,609 ± 701",
        "10",
        "Tianshou",
    ]
    assert "Other" not in words  # a task that the study does not have


def test_two_studies_are_compared_first_and_then_told_one_after_the_other(read):
    _, found = read(plain([1000, 3000]), plain([4000, 4000]))
    assert found.text_of("h2") == ["Comparison", "study-0", "study-1", "Deviations from the paper"]
    assert "+2,000 [+1,000, +3,000]" in found.words
    identities = [attributes["id"] for _, attributes in found.tags if "id" in attributes]
    assert len(identities) == len(set(identities))
