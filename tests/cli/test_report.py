"""The command that reports, as a user meets it."""

import subprocess
import sys

import pytest

from dgae_jax.cli.films import typical
from dgae_jax.report import results
from tests.helpers import ROOT, command
from tests.report.rows import plain, row, study, whole


@pytest.fixture
def run(monkeypatch, capsys):
    def run(*argv):
        monkeypatch.setattr(sys, "argv", ["report.py", *map(str, argv)])
        try:
            code = command("report")()
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return run


NAMES = ["learning", "returns", "improvement", "profile", "speed"]


def test_a_report_is_written_beside_the_results_and_a_line_names_each_file(run, tmp_path):
    path = study(tmp_path / "one", whole(("hopper",), ("ppo", "dppo"), 2))
    code, out, err = run(path, "--published")
    names = [f"{name}.{kind}" for name in NAMES for kind in ("png", "svg")] + ["report.html"]
    assert (code, out.splitlines(), err) == (
        0,
        [f"written {path / 'report' / name}" for name in names],
        "",
    )
    assert sorted(p.name for p in (path / "report").iterdir()) == sorted(names)
    assert (path / "report" / "learning.png").read_bytes().startswith(b"\x89PNG")
    assert (path / "report" / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert "Crosses are published results" in (path / "report" / "report.html").read_text()


def test_two_studies_are_compared_in_one_report(run, tmp_path):
    one, two = study(tmp_path / "one", plain([1, 3])), study(tmp_path / "two", plain([5, 5]))
    code, _, _ = run(one, two / "results.jsonl", "--out", tmp_path / "a" / "b")
    assert code == 0
    assert {p.name for p in (tmp_path / "a" / "b").iterdir()} == {"report.html"} | {
        f"{number}-{name}.{kind}"
        for number in (1, 2)
        for name in NAMES
        if name != "improvement"
        for kind in ("png", "svg")
    }
    assert "+3 [+2, +4]" in (tmp_path / "a" / "b" / "report.html").read_text()


def test_tables_in_a_document_are_replaced(run, tmp_path):
    path, document = study(tmp_path / "one", plain([1, 3])), tmp_path / "doc.md"
    document.write_text("before\n<!-- dgae report: returns -->\n<!-- /dgae report -->\nafter\n")
    code, out, _ = run(path, "--markdown", document)
    assert (code, out.splitlines()[-1]) == (0, f"written {document}: returns")
    assert "| hopper-v4 | DPPO | 2 | 2 ± 1 | 2 [1, 3] |" in document.read_text()


def test_the_run_to_film_is_the_middle_seed_of_the_best_algorithm(tmp_path):
    rows = plain([1, 9, 5], algo="ppo") + plain([4, 8, 9], algo="dppo")
    chosen = typical(list(results.read(study(tmp_path / "one", rows)).rows))
    assert (chosen.algo, chosen.final) == ("dppo", 8)


def test_films_of_runs_that_are_elsewhere_are_refused_before_anything_is_written(run, tmp_path):
    path = study(tmp_path / "one", plain([1, 3]))
    code, _, err = run(path, "--videos")
    assert (code, err) == (
        2,
        f"error: --videos True: must be left out: the runs of {path} are not here\n",
    )
    assert not (path / "report").exists()


@pytest.fixture
def good(tmp_path):
    return study(tmp_path / "good", [row()])


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        ([], "error: STUDIES: must be the directory of one study or more (--help lists every flag)"),
        (["{tmp}/none"], "error: {tmp}/none: must be the directory of a sweep; it does not exist"),
        (["{tmp}"], "error: {tmp}: must be the directory of a sweep, with study.json and results.jsonl"),
        (["{good}", "--out", "{good}/study.json"], "error: --out {good}/study.json: must be a directory that can be written"),
        (["{good}", "--out", "{good}/study.json/x"], "error: --out {good}/study.json/x: must be a directory that can be written"),
        (["{good}", "--out", "x" * 300], f"error: --out {'x' * 300}: must be a directory that can be written (File name too long)"),
        (["{good}", "--out", "/proc/x"], "error: --out /proc/x: must be a directory that can be written (No such file or directory)"),
        (["{good}", "--markdown", "{tmp}/no.md"],
         "error: --markdown {tmp}/no.md: must be a file that can be read (No such file or directory)"),
        (["{good}", "--markdown", "{good}/study.json"], "error: --markdown {good}/study.json: must be a file with "
         "each table between <!-- dgae report: NAME --> and <!-- /dgae report --> on lines of their own"),
        (["{good}", "{good}", "--markdown", "x"], "error: --markdown x: must be left out where several studies are compared"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_nothing_is_written(argv, sentence, run, good, tmp_path):
    def filled(text):
        return text.replace("{tmp}", str(tmp_path)).replace("{good}", str(good))

    assert run(*map(filled, argv)) == (2, "", filled(sentence) + "\n")
    assert not (good / "report").exists()


def test_flags_are_checked_before_matplotlib_and_jax_are_loaded():
    program = "import sys; import dgae_jax.cli.report; print(sorted({'jax', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"
