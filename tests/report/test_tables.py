"""Tables, as data, as Markdown and inside documents."""

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.report import tables
from tests.report.rows import plain, row


def test_interquartile_means_have_a_column_per_algorithm(grouped):
    groups = grouped([*plain([1, 2, 3, 4000]), *plain([5], "ant", "ppo")])
    table = tables.interquartile_means(groups)
    assert table.header == ("task", "PPO", "DPPO")
    assert table.rows == [("ant-v4", "5", "–"), ("hopper-v4", "–", "2")]


def test_final_returns_have_mean_std_iqm_best_and_each_seed(grouped):
    best = {"best": {"steps": 5, "return_mean": 1500.0}}
    rows = plain([1000, 3000], algo="ppo", **best) + plain([-1234.5], algo="dppo", best=None)
    (_, *ppo), (_, *dppo) = tables.returns(grouped(rows)).rows
    assert ppo[:3] == ["PPO", "2", "2,000 ± 1,414"]
    assert ppo[3:] == ["2,000 [1,000, 3,000]", "1,500 ± 0", "1,000 · 3,000"]
    assert dppo == ["DPPO", "1", "−1,234 ± –", "−1,234 [–]", "–", "−1,234"]


def test_sweeps_are_compared_where_both_have_results(grouped):
    first = grouped(plain([1, 3]) + plain([4], algo="ppo"))
    second = grouped(plain([10, 10]) + plain([7, 7], algo="a2c"))
    assert tables.comparison(first, second, ("A", "B")).rows == [
        ("hopper-v4", "PPO", "4 [–]", "–", "–"),
        ("hopper-v4", "DPPO", "2 [1, 3]", "10 [10, 10]", "+8 [+7, +9]"),
        ("hopper-v4", "A2C", "–", "7 [7, 7]", "–"),
    ]


def trained(scores, average, variant, env="hopper", **changes):
    curve = {"steps": [1, 2, 3], "return": [None, average - 1, average + 1]}
    run = f"{env}-{variant}"
    return plain(scores, env, **{"variant": variant, "run": run, "curve": curve} | changes)


def test_over_tasks_the_wins_of_a_variant_are_averaged(grouped):
    rows = [
        *trained([2, 4], 1, "scalar", algo="ppo"),
        *trained([3, 5], 1, "kappa"),  # three of four pairs are won
        *trained([3, 3], 1, "bellman"),
        *trained([2, 4], 1, "scalar", "walker2d", algo="ppo"),
        *trained([9, 9], 1, "kappa", "walker2d"),  # all are won
    ]
    ties = "0.50 [0.50, 0.50]"
    assert tables.attribution_over_tasks(grouped(rows)).rows == [
        ("DPPO (kappa)", "2", "4", "0.88 [0.50, 1.00]", ties),
        ("DPPO (bellman)", "1", "2", "0.50 [0.00, 1.00]", ties),
    ]


def block(name, inside=""):
    return f"<!-- dgae report: {name} -->\n{inside}<!-- /dgae report -->\n"


def test_tables_of_a_document_are_replaced_and_the_rest_stays(grouped, tmp_path):
    path, groups, old = tmp_path / "doc.md", grouped(plain([1, 3])), "| old |\n"
    path.write_text(f"# Title\n{block('returns', old)}between\n{block('speed')}end\n")
    returns, speed = (tables.markdown(t(groups)) + "\n" for t in (tables.returns, tables.speed))
    assert "| --- | --- | ---: |" in returns
    for _ in range(2):
        assert tables.replace(path, groups, "sweep") == ["returns", "speed"]
        new = f"# Title\n{block('returns', returns)}between\n{block('speed', speed)}end\n"
        assert path.read_text() == new
    path.write_text(block("returns of short") + block("speed of long"))
    assert tables.replace(path, groups, "long") == ["speed"]
    assert path.read_text() == block("returns of short") + block("speed of long", speed)


TABLES = "with tables of sweep between lines <!-- dgae report: NAME --> and <!-- /dgae report -->"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("nothing", TABLES),
        ("\xff", "that can be read"),
        ("<!-- dgae report: returns -->\n" + block("speed"), TABLES),
        (block("returns") + block("x"), "NAME is one of iqm, returns"),
        (block("returns of other"), TABLES),
    ],
)
def test_document_without_a_table_to_replace_is_refused(text, sentence, grouped, tmp_path):
    path = tmp_path / "doc.md"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError) as caught:
        tables.replace(path, grouped([row()]), "sweep")
    assert str(caught.value).startswith(f"markdown {path}: must be a file ")
    assert sentence in str(caught.value)
