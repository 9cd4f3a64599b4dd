"""Tables, as data, as Markdown and inside documents."""

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.report import markdown, tables
from tests.report.rows import plain, row


def test_final_returns_are_mean_std_iqm_best_and_each_seed(grouped):
    best = {"best": {"steps": 5, "return_mean": 1500.0}}
    rows = plain([1000, 3000], algo="ppo", **best) + plain([1234.5], algo="dppo", best=None)
    assert tables.returns(grouped(rows)).rows == [
        (
            "hopper-v4",
            "PPO",
            "2",
            "2,000 ± 1,414",
            "2,000 [1,000, 3,000]",
            "1,500 ± 0",
            "1,000 · 3,000",
        ),
        ("hopper-v4", "DPPO", "1", "1,234 ± –", "1,234 [–]", "–", "1,234"),
    ]


def test_samples_to_reach_are_whole_numbers_or_a_dash(grouped):
    ppo = plain([1], algo="ppo", curve={"steps": [10, 2000], "return": [4, 100]})
    dppo = plain([1], algo="dppo", curve={"steps": [10, 2000], "return": [None, 60]})
    table = tables.reach(grouped(ppo + dppo))
    assert table.header == ("task", "algorithm", "best mean", "samples to 50 %", "samples to 90 %")
    assert table.rows == [
        ("hopper-v4", "PPO", "100", "2,000", "2,000"),
        ("hopper-v4", "DPPO", "100", "2,000", "–"),
    ]


def test_speed_is_samples_and_seconds_and_the_machine(grouped):
    rows = plain([1, 2], samples_per_second=12_000.0, seconds=80.0)
    assert tables.speed(grouped(rows)).rows == [
        ("hopper-v4", "DPPO", "12,000 ± 0", "80 ± 0", "cpu: x, 1 cores")
    ]


def test_two_studies_are_compared_where_both_have_results(grouped):
    first = grouped(plain([1, 3]) + plain([4], algo="ppo"))
    second = grouped(plain([10, 10]) + plain([7, 7], algo="a2c"))
    table = tables.comparison(first, second, ("A", "B"))
    assert table.header == (
        "task",
        "algorithm",
        "A, IQM [95 %]",
        "B, IQM [95 %]",
        "difference [95 %]",
    )
    assert table.rows == [
        ("hopper-v4", "PPO", "4 [–]", "–", "–"),
        ("hopper-v4", "DPPO", "2 [1, 3]", "10 [10, 10]", "+8 [+7, +9]"),
        ("hopper-v4", "A2C", "–", "7 [7, 7]", "–"),
    ]


def test_variants_are_named_and_compared_with_the_first_of_their_task_noise_making_another_task(
    grouped,
):
    noise = row("hopper", "dppo")["config"] | {"noise": {"reward": 0.5}}

    def trained(scores, average, variant, **changes):
        curve = {"steps": [1, 2, 3], "return": [None, average - 1, average + 1]}
        return plain(scores, variant=variant, cell=f"hopper-{variant}", curve=curve, **changes)

    rows = [
        *trained([1, 3], 2, "scalar", algo="ppo"),
        *trained([10, 10], 4, "bellman", hash="another"),
        *trained([5, 5], 1, "kappa"),
        *trained([7], 6, "kappa+noise", config=noise, hash="third"),
    ]
    assert tables.attribution(grouped(rows)).rows == [
        ("hopper-v4", "PPO (scalar)", "2", "2 ± 1", "–", "2 ± 0", "–"),
        ("hopper-v4", "DPPO (bellman)", "2", "10 ± 0", "+8 [+7, +9]", "4 ± 0", "+2 [+2, +2]"),
        ("hopper-v4", "DPPO (kappa)", "2", "5 ± 0", "+3 [+2, +4]", "1 ± 0", "−1 [−1, −1]"),
        ("hopper-v4 with noise", "DPPO (kappa)", "1", "7 ± –", "–", "6 ± –", "–"),
    ]


def test_over_tasks_a_variant_is_above_the_first_as_often_as_its_seeds_are_on_average(grouped):
    def trained(scores, variant, env, **changes):
        return plain(
            scores,
            env=env,
            variant=variant,
            cell=f"{env}-{variant}",
            curve={"steps": [1, 2], "return": [1, 1]},
            **changes,
        )

    rows = [
        *trained([2, 4], "scalar", "hopper", algo="ppo"),
        *trained([3, 5], "kappa", "hopper"),
        *trained([3, 3], "bellman", "hopper", hash="another"),
        *trained([2, 4], "scalar", "walker2d", algo="ppo"),
        *trained([9, 9], "kappa", "walker2d"),
    ]
    table = tables.attribution_over_tasks(grouped(rows))
    assert (
        table.rows
        == [  # on Hopper three of the four pairs are won, on Walker2d all; over the run all are equal, which counts a half
            ("DPPO (kappa)", "2", "4", "0.88 [0.50, 1.00]", "0.50 [0.50, 0.50]"),
            ("DPPO (bellman)", "1", "2", "0.50 [0.00, 1.00]", "0.50 [0.50, 0.50]"),
        ]
    )


def test_the_risk_of_a_policy_is_the_mean_of_the_worst_quarter_of_its_episodes(grouped):
    final = {"engine": "native", "return_mean": 7.75}
    rows = (
        plain([0], final=final | {"returns": [11, 3, 9, 10, 5, 8, 7, 9]})
        + plain([0, 0], final=final | {"returns": [8]})[1:]
    )
    assert tables.risk(grouped(rows)).rows == [
        ("hopper-v4", "DPPO", "2", "8 ± 0", "8 [8, 8]", "6 ± 3", "6 [4, 8]")
    ]


def test_markdown_has_numbers_to_the_right_and_no_bars_inside_cells():
    table = tables.Table(("task", "algorithm", "x"), [("a|b", "PPO", "1")])
    assert (
        tables.markdown(table)
        == "| task | algorithm | x |\n| --- | --- | ---: |\n| a\\|b | PPO | 1 |"
    )


DOCUMENT = """# Title
<!-- dgae report: returns -->
old
<!-- /dgae report -->
between
<!-- dgae report: speed -->
<!-- /dgae report -->
end
"""


def test_every_block_of_a_document_is_replaced_and_the_rest_stays(grouped, tmp_path):
    path, groups = tmp_path / "doc.md", grouped(plain([1, 3]))
    path.write_text(DOCUMENT)
    assert markdown.replace(path, groups, "study") == ["returns", "speed"]
    new = path.read_text()
    assert new == DOCUMENT.replace("old\n", tables.markdown(tables.returns(groups)) + "\n").replace(
        "speed -->\n", "speed -->\n" + tables.markdown(tables.speed(groups)) + "\n"
    )
    markdown.replace(path, groups, "study")
    assert path.read_text() == new


def test_a_table_of_a_study_is_replaced_by_a_report_on_that_study_only(grouped, tmp_path):
    path, groups = tmp_path / "doc.md", grouped(plain([1, 3]))
    text = "<!-- dgae report: returns of short -->\n<!-- /dgae report -->\n<!-- dgae report: speed of long -->\n<!-- /dgae report -->\n"
    path.write_text(text)
    assert markdown.replace(path, groups, "long") == ["speed"]
    assert path.read_text() == text.replace(
        "of long -->\n", "of long -->\n" + tables.markdown(tables.speed(groups)) + "\n"
    )
    with pytest.raises(
        ConfigError, match="must be a file with a table of other; its tables are of short, long"
    ):
        markdown.replace(path, groups, "other")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("nothing", "a file with <!-- dgae report: NAME --> and <!-- /dgae report --> on lines of their own"),
        ("<!-- dgae report: returns -->\n", "a file with <!-- /dgae report --> after the table returns"),
        ("<!-- dgae report: returns -->\n<!-- dgae report: speed -->\n<!-- /dgae report -->",
         "a file with <!-- /dgae report --> after the table returns"),
        ("<!-- /dgae report -->\n", "a file without <!-- /dgae report --> where no table begins"),
        ("<!-- dgae report: x -->\n<!-- /dgae report -->",
         "a file with tables named returns, improvement, attribution, attribution-over-tasks, risk, reach, speed, not x"),
        ("<!-- dgae report: returns -->\n<!-- /dgae report -->\n<!-- dgae report: speed of long -->\n<!-- /dgae report -->",
         "a file with returns of STUDY, not returns, where other tables are of long"),
    ],
)  # fmt: skip
def test_markers_that_do_not_match_are_refused(text, sentence, tmp_path):
    path = tmp_path / "doc.md"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        markdown.blocks(path, "study")
    assert str(caught.value) == f"markdown {path}: must be {sentence}"


def test_a_document_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "bytes").write_bytes(b"\xff")
    for name, reason in (
        ("none", "No such file or directory"),
        ("bytes", "not text in UTF-8"),
        (".", "Is a directory"),
    ):
        with pytest.raises(ConfigError, match=reason):
            markdown.blocks(tmp_path / name, "study")
