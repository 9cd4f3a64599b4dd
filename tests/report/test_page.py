"""The page, read as HTML."""

import base64
import re
from collections import Counter

import pytest

from dgae_jax.report import results
from dgae_jax.report.page import page
from dgae_jax.report.results import Published
from tests.report.rows import plain, row, study, whole


@pytest.fixture
def read(tmp_path):
    """The page of rows; every tag that is opened must be closed."""

    def read(*sweeps, planned=(), published=()):
        named = [study(tmp_path / f"sweep-{n}", rows, planned) for n, rows in enumerate(sweeps)]
        text = page([results.read(path) for path in named], published)
        opened = Counter(re.findall(r"<(\w+)", text))
        for void in ("meta", "img"):
            del opened[void]
        assert opened == Counter(re.findall(r"</(\w+)>", text))
        return text

    return read


def values(text, attribute):
    return re.findall(rf'\b{attribute}="([^"]*)"', text)


def test_page_needs_no_other_file_and_its_links_lead_to_headings(read):
    sweep = whole(("hopper",), ("ppo", "dppo"), 2)
    assert len(values(read(sweep), "href")) == 8
    text = read(sweep, sweep)
    headings = re.findall("<h2[^>]*>(.*?)</h2>", text)
    assert headings == ["Comparison", "sweep-0", "sweep-1", "Deviations from the paper"]
    assert not re.search(r"<(script|link|iframe|object|embed)\b|@import|url\(|srcset|poster", text)
    assert all(src.startswith("data:") for src in values(text, "src"))
    ids, links = values(text, "id"), values(text, "href")
    assert len(ids) == len(set(ids))
    assert set(links) <= {f"#{each}" for each in ids}


def test_pictures_are_whole_and_their_alternative_texts_have_the_numbers(read):
    text = read(plain([1000, 2000], algo="ppo") + plain([3000, 3100], algo="dppo"))
    for src in values(text, "src"):
        data = src.removeprefix("data:image/svg+xml;base64,")
        assert base64.b64decode(data).rstrip().endswith(b"</svg>")
    returns, curves, improvement, *_ = values(text, "alt")
    assert returns == "Final returns on hopper-v4: PPO 1,500, DPPO 3,050."
    assert re.search(r"Learning curves on hopper-v4; .*: PPO [\d,]+, DPPO [\d,]+\.$", curves, re.S)
    assert improvement == "Probability of improvement: DPPO over PPO on hopper-v4 1.00."


def test_content_of_files_is_escaped(read):
    evil = '<script>alert("x")</script>'
    written = row(run=evil) | dict.fromkeys(("env", "command", "git_revision"), evil)
    written |= {"machine": {evil: evil}, "versions": {evil: evil}, "env_version": None}
    written["config"] |= {evil: {"a": evil}}
    text = read([written])
    assert "<script" not in text
    assert "&lt;script&gt;alert(" in text


def test_settings_that_differ_from_the_first_of_the_algorithm_are_marked(read):
    first = row("hopper", "ppo")
    policy = first["config"]["policy"] | {"initial_std": 3.0}
    changed = {"env": "walker2d", "num_envs": 7, "gamma": 0.5, "policy": policy}
    second = row("walker2d", "ppo", config=first["config"] | changed)
    text = read([first, second, row("swimmer", "dppo")])
    assert re.findall("<mark>(.*?)</mark>", text) == ["walker2d", "7", "0.5", "3.0"]
    assert first["command"] in text
    assert all(f">{fact}<" in text for fact in ("jax", "0.10.2", "device"))


def test_summary_counts_runs_and_names_those_without_a_result(read):
    diverged = row(seed=1, final={"engine": "jax", "return_mean": None, "returns": [None]})
    text = " ".join(read([row(), diverged], planned=["hopper-dppo-2"]).split())
    numbers = "1 trained run: 1 task, 1 algorithm, 1 seed, 1,000,000 environment steps each."
    assert numbers in text
    assert "Runs without a result: hopper-dppo-2." in text
    assert "not finite: seed 1 of hopper-dppo-1." in text


def test_video_of_a_task_is_embedded(read, tmp_path):
    videos = tmp_path / "sweep-0" / "videos"
    videos.mkdir(parents=True)
    for name in ("hopper-v4", "brax-ant"):
        (videos / f"{name}.mp4").write_bytes(name.encode())
    text = read([row(), row("ant"), row(run="b") | {"env": "brax:ant", "env_version": None}])
    found = re.findall(r'src="data:video/mp4;base64,([^"]*)"', text)
    assert [base64.b64decode(data) for data in found] == [b"hopper-v4", b"brax-ant"]


def test_published_results_of_its_tasks_are_listed_with_their_sources(read):
    hopper = Published("hopper", 10**6, "PPO", 2609.0, 701.0, 10, "Tianshou")
    ant = Published("ant", 10**6, "PPO", 3258.0, None, None, "Other")
    text = read([row()], published=[hopper, ant])
    assert re.search(r"<td>2,609 ± 701</td>\s*<td>10</td>\s*<td>Tianshou</td>", text)
    assert "Other" not in text
