"""`dgae report` as a user meets it."""

import pytest

from dgae_jax.cli.report import typical
from dgae_jax.report import results
from tests.report.rows import plain, row, study, whole

FIGURES = {"learning", "returns", "improvement", "profile"}


def test_a_report_is_written_beside_the_results(dgae, tmp_path):
    path = study(tmp_path / "one", whole(("hopper",), ("ppo", "dppo"), 2))
    code, out, err = dgae("report", path, "--published")
    names = {f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")} | {"report.html"}
    assert (code, err) == (0, "")
    assert set(out.splitlines()) == {f"written {path / 'report' / name}" for name in names}
    assert {p.name for p in (path / "report").iterdir()} == names
    assert "published" in (path / "report" / "report.html").read_text()


def test_two_sweeps_are_compared(dgae, tmp_path):
    one, two = study(tmp_path / "one", plain([1, 3])), study(tmp_path / "two", plain([5, 5]))
    assert dgae("report", one, two / "results.jsonl", "--out", tmp_path / "a" / "b")[0] == 0
    assert "+3 [+2, +4]" in (tmp_path / "a" / "b" / "report.html").read_text()


def test_tables_in_a_document_are_replaced(dgae, tmp_path):
    path, document = study(tmp_path / "one", plain([1, 3])), tmp_path / "doc.md"
    document.write_text("before\n<!-- dgae report: returns -->\n<!-- /dgae report -->\nafter\n")
    code, out, _ = dgae("report", path, "--markdown", document)
    assert (code, out.splitlines()[0]) == (0, f"written {document}: returns")
    assert "| hopper-v4 | DPPO | 2 |" in document.read_text()


def test_the_typical_run_is_the_median_seed_of_the_best_algorithm(tmp_path):
    rows = plain([1, 9, 5], algo="ppo") + plain([4, 8, 9], algo="dppo")
    chosen = typical(list(results.read(study(tmp_path / "one", rows)).rows))
    assert (chosen.algo, chosen.final) == ("dppo", 8)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("", "SWEEPS: must be the directory of one sweep or more"),
        ("TMP/none", "TMP/none: must be the directory of a sweep"),
        ("GOOD --videos", "--videos True: must be left out: the runs of GOOD are not here"),
        ("GOOD --out GOOD/study.json", "--out GOOD/study.json: must be a directory that can be"),
        ("GOOD --markdown TMP/no.md", "--markdown TMP/no.md: must be a file that can be read"),
        ("GOOD GOOD --markdown x", "--markdown x: cannot be combined with several sweeps"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(argv, message, dgae, tmp_path):
    good = study(tmp_path / "good", [row()])
    words = argv.replace("GOOD", str(good)).replace("TMP", str(tmp_path)).split()
    code, out, err = dgae("report", *words)
    assert (code, out) == (2, "")
    err = err.replace(str(good), "GOOD").replace(str(tmp_path), "TMP")
    assert err.startswith(f"error: {message}")
    assert not (good / "report").exists()
